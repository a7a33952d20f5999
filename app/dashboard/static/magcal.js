// What every page uses: the public API, elements, numbers, notices.
import { live } from "./live.js";
import { table } from "./table.js";

const scopes = new Set((document.body.dataset.scopes ?? "").split(" "));
export const may = (...wanted) => scopes.has("admin") || wanted.some((scope) => scopes.has(scope));

export class Problem extends Error {
  constructor(body) {
    super(body.detail || body.title);
    this.body = body;
  }
}

// Answers that the page has brought along. Each is taken once: what is asked again is asked of the service.
function brought(path) {
  const node = document.querySelector(`script[data-answer="${CSS.escape(path)}"]`);
  node?.remove();
  return node ? JSON.parse(node.textContent) : null;
}

export async function api(path, { method = "GET", json, body, headers = {}, seen } = {}) {
  const known = method === "GET" ? brought(path) : null;
  if (known) return known;
  const answer = await fetch(`/api/v1${path}`, {
    method,
    headers: { Accept: "application/json", ...(json ? { "Content-Type": "application/json" } : {}), ...headers },
    body: json ? JSON.stringify(json) : body,
  });
  if (answer.status === 401) {
    location.reload();
    return new Promise(() => {});
  }
  seen?.(answer);
  const found = answer.status === 204 ? null : await answer.json();
  if (!answer.ok) throw new Problem(found);
  return found;
}

export async function listed(path, most = 1000) {
  const items = [];
  let cursor = null;
  do {
    const ask = `limit=${Math.min(most, 1000)}${cursor ? `&cursor=${encodeURIComponent(cursor)}` : ""}`;
    const page = await api(`${path}${path.includes("?") ? "&" : "?"}${ask}`);
    items.push(...page.items);
    cursor = page.next;
  } while (cursor && items.length < most);
  return items;
}

export function h(tag, attributes = {}, ...children) {
  const node = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (value === false || value === null || value === undefined) continue;
    if (name.startsWith("on")) node.addEventListener(name.slice(2), value);
    else node.setAttribute(name, value === true ? "" : value);
  }
  node.append(...children.flat(3).filter((child) => child !== null && child !== undefined && child !== false));
  return node;
}

// Resolves once what was shown is painted: what a reader does not wait for begins after that.
export const painted = () => new Promise((resolve) => {
  if (document.hidden) resolve();
  else requestAnimationFrame(() => setTimeout(resolve));
});

export function show(...children) {
  document.getElementById("main").replaceChildren(...children.flat(2).filter(Boolean));
}

export function title(text) {
  document.title = `${text} · magcal`;
}

export const fixed = (value, digits = 1) =>
  typeof value === "number" && Number.isFinite(value)
    ? value.toLocaleString("en", { minimumFractionDigits: digits, maximumFractionDigits: digits }).replace(/^-(?=[0.]*$)/, "")
    : "–";
export const nt = (value, digits = 1) => (typeof value === "number" ? `${fixed(value, digits)} nT` : "–");
export const time = (text) => (text ? text.slice(0, 19).replace("T", " ") : "–");
export const short = (id) => id.slice(-8);

export function age(text, now = Date.now()) {
  if (!text) return "–";
  const minutes = (now - Date.parse(text)) / 60000;
  if (minutes < 1) return "now";
  if (minutes < 60) return `${Math.floor(minutes)} min`;
  if (minutes < 48 * 60) return `${Math.floor(minutes / 60)} h`;
  return `${Math.floor(minutes / 1440)} d`;
}

export const ago = (text) => (age(text) === "now" ? "just now" : `${age(text)} ago`);

export const SYMBOLS = { accept: "●", weak: "◆", refuse: "✕" };

export function grade(name) {
  return name ? h("span", { class: `badge ${name}` }, `${SYMBOLS[name] ?? ""} ${name}`) : "–";
}

// Whether a session agrees with the set in force: its grade as classes, signs and words.
export const AGREEMENTS = { disagrees: "refuse", watch: "weak", agrees: "accept", too_short: "", not_judged: "" };
export const AGREEMENT_SIGNS = { disagrees: "✕", watch: "◆", agrees: "●", too_short: "·", not_judged: "?" };

export function agreement({ grade: name }) {
  return h("span", { class: `badge ${AGREEMENTS[name]}` }, `${AGREEMENT_SIGNS[name]} ${name.replaceAll("_", " ")}`);
}

export function state(name) {
  return h("span", { class: `badge state-${name}` }, name);
}

export function tiles(...entries) {
  return h("dl", { class: "tiles" }, entries.filter(Boolean).map(([name, value, note]) =>
    h("div", {}, h("dt", {}, name), h("dd", {}, value ?? "–", note ? h("small", {}, note) : null))));
}

export function section(heading, ...children) {
  const id = heading.toLowerCase().replace(/[^a-z0-9]+/g, "-");
  return h("section", {}, h("h2", { id }, heading), ...children);
}

// Links to the sections of a page that is longer than a few screens.
export function contents() {
  const headings = [...document.querySelectorAll("#main > section > h2[id]")];
  return h("nav", { class: "contents", "aria-label": "On this page" }, headings.map((one) => h("a", { href: `#${one.id}` }, one.textContent)));
}

export function facts(rows) {
  return h("table", { class: "facts" }, h("tbody", {}, rows.filter(([, value]) => value !== null && value !== undefined).map(
    ([name, value]) => h("tr", {}, h("th", { scope: "row" }, name), h("td", {}, value)))));
}

export function notice(text, kind = "") {
  const node = h("p", { class: `notice ${kind}` }, text, h("button", {
    type: "button", class: "quiet", "aria-label": "Dismiss", onclick: () => node.remove() }, "✕"));
  document.getElementById("notices").append(node);
  setTimeout(() => node.remove(), 12000);
}

export function problemTable(problem) {
  const body = problem.body ?? { detail: String(problem) };
  return h("div", { class: "notice refuse", role: "alert" }, h("strong", {}, body.detail || body.title),
    body.errors?.length
      ? table([{ name: "where", value: (fault) => fault.where }, { name: "why", value: (fault) => fault.why }], body.errors, { caption: "Faults", file: "faults" })
      : null, causes(body.diagnosis));
}

// What is wrong with the input, the cause first, then what explains the data about as well, and what was tried.
export function causes(diagnosis) {
  if (!diagnosis?.findings?.length) return null;
  const { candidates, findings, residual_share: share } = diagnosis;
  const percent = (value) => `${fixed(100 * value, 2)} %`;
  return h("div", { class: "causes" },
    findings.map((one) => h("p", {}, h("strong", {}, "Cause: "), h("code", {}, one.code), ` ${one.text}`,
      one.alternatives?.length ? h("small", {}, `About as likely: ${one.alternatives.map((other) => other.text).join("; ")}.`) : null)),
    share === null || share === undefined ? null : h("p", { class: "muted" }, `The best sensor leaves ${percent(share)} of the field under the reference that was given.`),
    candidates?.length
      ? table([{ name: "tried", value: (r) => r.code }, { name: "what", value: (r) => r.text },
        { name: "leaves of the field", numeric: true, value: (r) => r.residual_share, show: (r) => percent(r.residual_share) }],
      candidates, { caption: "Other references that were tried", file: "causes" })
      : null);
}

// A form that shows what was wrong with it beside its fields and is busy while it is sent.
export function form(fields, label, send) {
  const faults = h("div");
  const button = h("button", { class: "primary" }, label);
  const node = h("form", { class: "inline" }, fields, button, faults);
  node.addEventListener("submit", async (event) => {
    event.preventDefault();
    button.disabled = true;
    faults.replaceChildren();
    try {
      await send(Object.fromEntries(new FormData(node)), node);
    } catch (problem) {
      faults.replaceChildren(problemTable(problem));
    } finally {
      button.disabled = false;
    }
  });
  return node;
}

export function field(name, label, attributes = {}, ...options) {
  const tag = options.length ? "select" : attributes.rows ? "textarea" : "input";
  const id = `field-${name}-${Math.random().toString(36).slice(2, 8)}`;
  return h("div", { class: "field" }, h("label", { for: id }, label), h(tag, { id, name, ...attributes }, options));
}

export const option = (value, text = value, selected = false) => h("option", { value, selected }, text);

// A question in a modal dialog; resolves to true where it is confirmed.
export function confirm(heading, content, label, { isGrey = false } = {}) {
  return new Promise((resolve) => {
    const dialog = h("dialog", { "aria-labelledby": "dialog-title" }, h("form", { method: "dialog" },
      h("h2", { id: "dialog-title" }, heading), content,
      h("div", { class: "actions" }, h("button", { value: "yes", class: isGrey ? "grey" : "primary" }, label),
        h("button", { value: "no", autofocus: true, formnovalidate: true }, "Keep as it is"))));
    dialog.addEventListener("close", () => {
      dialog.remove();
      resolve(dialog.returnValue === "yes");
    });
    document.body.append(dialog);
    dialog.showModal();
  });
}

export async function start(build) {
  try {
    await build();
  } catch (problem) {
    if (!(problem instanceof Problem)) throw problem;
    show(h("h1", {}, problem.body.status === 404 ? "Not found" : "This cannot be shown"), problemTable(problem),
      h("p", {}, h("a", { href: "/" }, "To the satellites")));
  }
}

// What needs attention, counted in the header of every page.
export function counters(counts) {
  for (const [name, sign] of [["act", "✕"], ["watch", "◆"]]) {
    const node = document.querySelector(`.counter.${name}`);
    if (!node) continue;
    node.textContent = `${sign} ${counts[name]}`;
    node.setAttribute("aria-label", `${counts[name]} ${name === "act" ? "to do" : "to watch"}`);
    node.classList.toggle("none", counts[name] === 0);
  }
}

if (document.querySelector(".counter") && location.pathname !== "/") {
  live(() => api("/attention?limit=1").then((answer) => counters(answer.counts)), { types: ["attention.raised", "attention.cleared", "parameter_set.activated"], lostMs: 30000 });
}

const toggle = document.getElementById("theme");
const root = document.documentElement;
const label = () => { toggle.textContent = root.dataset.theme === "dark" ? "Light" : "Dark"; };
if (toggle) {
  label();
  toggle.addEventListener("click", () => {
    root.dataset.theme = root.dataset.theme === "dark" ? "light" : "dark";
    localStorage.setItem("magcal-theme", root.dataset.theme);
    label();
    document.dispatchEvent(new Event("magcal-theme"));
  });
}
for (const link of document.querySelectorAll("header nav a")) {
  const part = /^\/(satellites|sessions|parameter-sets|compare)/.test(location.pathname) ? "/" : location.pathname.replace(/^(\/reprocessings)\/.*/, "$1");
  const here = link.getAttribute("href") === part;
  if (here) link.setAttribute("aria-current", link.getAttribute("href") === location.pathname ? "page" : "true");
}
