// A table of thousands that the service searches, sorts, counts and cuts: what it shows stands in the page's address.
import { api, fixed, h, notice } from "./magcal.js";
import { AT_A_GLANCE, saveCsv } from "./table.js";

const STEPS = [50, 200, 1000];

// columns: [{ name, label?, value: row => text, show?: row => text or node, numeric?, sort?: the service's name of the order }]
// facets: [{ name, label, values: { value: word }, of: answer => ({ value: count }) }]
export function listing(path, columns, { caption, file, facets = [], empty, sort, given = {}, row: look = () => "", changed = () => {} }) {
  const asked = new URLSearchParams(location.search);
  const names = ["q", "sort", "limit", ...facets.map((one) => one.name)];
  const state = Object.fromEntries(names.map((name) => [name, asked.get(name)]).filter(([, value]) => value));
  let typing = null;
  let drawn = "";
  let number = 0;

  const search = h("input", { type: "search", placeholder: "Search", "aria-label": `Search ${caption}`, value: state.q ?? "", oninput: () => {
    clearTimeout(typing);
    typing = setTimeout(() => set({ q: search.value.trim() || null, limit: null }), 250);
  } });
  const count = h("span", { class: "muted", role: "status" });
  const chips = h("div", { class: "chips" });
  const head = columns.map((column) => h("th", { scope: "col", class: column.numeric ? "n" : "" }, column.sort
    ? h("button", { type: "button", class: "sort", onclick: () => turn(column) }, column.name) : column.name));
  const body = h("tbody");
  const more = h("button", { type: "button", onclick: () => set({ limit: STEPS.find((step) => step > Number(state.limit ?? STEPS[0])) ?? STEPS.at(-1) }) });

  const order = () => state.sort ?? sort;
  function turn(column) {
    const isSame = order().replace("-", "") === column.sort;
    const isDown = isSame ? !order().startsWith("-") : Boolean(column.numeric);
    mark(`${isDown ? "-" : ""}${column.sort}`);
    set({ sort: `${isDown ? "-" : ""}${column.sort}` });
  }

  function mark(by) {
    columns.forEach((column, i) => {
      if (column.sort && by.replace("-", "") === column.sort) head[i].setAttribute("aria-sort", by.startsWith("-") ? "descending" : "ascending");
      else head[i].removeAttribute("aria-sort");
    });
  }

  function query(limit = state.limit ?? STEPS[0]) {
    const kept = Object.fromEntries(Object.entries({ ...given, sort, ...state, limit }).filter(([, value]) => value));
    return new URLSearchParams(Object.entries(kept).sort(([a], [b]) => a.localeCompare(b)));
  }

  function set(values) {
    Object.assign(state, values);
    for (const name of names) if (!state[name]) delete state[name];
    const address = new URLSearchParams(location.search);
    for (const name of names) {
      if (state[name]) address.set(name, state[name]);
      else address.delete(name);
    }
    history.replaceState(null, "", `${location.pathname}${address.size ? `?${address}` : ""}${location.hash}`);
    return refresh();
  }

  async function refresh() {
    const mine = ++number;
    const answer = await api(`${path}?${query()}`).catch((problem) => notice(problem.message, "refuse"));
    if (!answer || mine !== number) return;
    changed(answer);
    const text = JSON.stringify(answer);
    if (text === drawn) return;
    drawn = text;
    const before = held();
    draw(answer);
    restore(before);
  }

  // What a reader has open or has the focus on, by row: it is so again once the rows are drawn anew.
  const keyOf = (row) => columns.slice(0, 2).map((column) => column.value(row)).join(" ");
  const inside = (line) => [...line.querySelectorAll("a[href], button, summary, input, select")];

  function held() {
    const open = new Set([...body.rows].filter((line) => line.querySelector("details[open]")).map((line) => line.dataset.key));
    const line = document.activeElement?.closest?.("tr");
    const isOurs = line && body.contains(line);
    return { open, key: isOurs ? line.dataset.key : null, at: isOurs ? inside(line).indexOf(document.activeElement) : -1 };
  }

  function restore({ open, key, at }) {
    for (const line of body.rows) {
      if (open.has(line.dataset.key)) line.querySelector("details")?.setAttribute("open", "");
      if (key !== null && line.dataset.key === key) inside(line)[at]?.focus();
    }
  }

  function cellOf(row, column) {
    const shown = (column.show ?? column.value)(row) ?? "–";
    return h("td", { class: column.numeric ? "n" : "", "data-label": column.name }, shown);
  }

  function draw(answer) {
    mark(order());
    chips.replaceChildren(...facets.map((facet) => {
      const counts = facet.of(answer);
      const word = (value) => `${facet.values[value] ?? value} ${fixed(counts[value] ?? 0, 0)}`;
      return h("div", { class: "facet", role: "group", "aria-label": facet.label }, h("span", { class: "muted" }, facet.label),
        Object.keys(facet.values).filter((value) => counts[value] || state[facet.name] === value).map((value) => h("button", {
          type: "button", class: `chip ${value}`, "aria-pressed": String(state[facet.name] === value),
          onclick: () => set({ [facet.name]: state[facet.name] === value ? null : value, limit: null }) }, word(value))));
    }));
    body.replaceChildren(...answer.items.map((row) => h("tr", { class: look(row) || null, "data-key": keyOf(row) }, columns.map((column) => cellOf(row, column)))));
    search.hidden = answer.total <= AT_A_GLANCE && !state.q && !facets.some((one) => state[one.name]) && document.activeElement !== search;
    const left = answer.total - answer.items.length;
    count.textContent = answer.total ? `${fixed(answer.items.length, 0)} of ${fixed(answer.total, 0)}` : empty;
    more.hidden = left <= 0 || Number(state.limit ?? 0) >= STEPS.at(-1);
    more.textContent = `Show more (${fixed(left, 0)} not shown)`;
  }

  async function save() {
    const answer = await api(`${path}?${query(STEPS.at(-1))}`);
    saveCsv(columns, answer.items, file);
    if (answer.next) notice(`Only the first ${fixed(answer.items.length, 0)} of ${fixed(answer.total, 0)} were saved.`);
  }

  const node = h("div", { class: "table listing" },
    h("div", { class: "tools" }, search, count, h("button", { type: "button", class: "quiet", onclick: save, "aria-label": `Save ${caption} as CSV` }, "CSV")),
    facets.length ? chips : null,
    h("div", { class: "scroll", tabindex: "0", role: "region", "aria-label": caption },
      h("table", { class: "cards" }, h("thead", {}, h("tr", {}, head)), body)), more);
  node.refresh = refresh;
  return node;
}
