// A look at a file before it is sent: its first rows, what each column is taken for, and what would be kept.
// Whoever may operate chooses columns, unit and form of the times; the choice is kept on the magnetometer.
import { api, field, fixed, h, may, nt, option, problemTable, time } from "./magcal.js";

const WAIT_MS = 350;
const NEEDED = ["time", "bx", "by", "bz"];
const WORDS = { time: "Time", date: "Date, where it has a column of its own", bx: "bx", by: "by", bz: "bz" };
const UNITS = ["nT", "uT", "mT", "T", "G", "mG", "counts"];
const OF_TIME = /^(date|time|time_.*|gps_week|gps_seconds|year|day_of_year)$/;
const NEEDS_EPOCH = new Set(["boot", "doy"]);
const PATTERN = "pattern";

// What is chosen in the form, as the service's query and as the magnetometer keeps it.
function chosen(form, kept) {
  const values = Object.fromEntries(new FormData(form));
  const columns = Object.fromEntries(Object.entries(kept.columns ?? {}).filter(([name]) => !OF_TIME.test(name) && !NEEDED.includes(name)));
  for (const name of ["date", ...NEEDED]) if (values[name] && (values[name] !== name || name === "date")) columns[name] = values[name];
  const declared = values.time_format === PATTERN ? values.pattern.trim() : values.time_format;
  return { columns, unit: values.unit, nt_per_count: values.unit === "counts" && values.nt_per_count ? Number(values.nt_per_count) : null,
    time_format: declared || null, time_epoch: NEEDS_EPOCH.has(declared) && values.time_epoch ? values.time_epoch : null };
}

function queryOf(magnetometer, choice) {
  const query = new URLSearchParams({ magnetometer });
  if (!choice) return query;
  query.set("columns", JSON.stringify(choice.columns));
  query.set("time_format", choice.time_format ?? "iso");
  for (const name of ["unit", "nt_per_count", "time_epoch"]) if (choice[name] !== null) query.set(name, choice[name]);
  return query;
}

// What a first look suggests: the columns that may be meant, else those that are taken.
function suggestion(look) {
  const taken = Object.fromEntries(look.columns.filter((one) => one.taken_for).map((one) => [one.taken_for, one.name]));
  const kept = look.reading.columns ?? {};
  return { ...kept, ...taken, ...look.suggested_columns };
}

function choices(look) {
  const of = suggestion(look);
  const select = (name) => field(name, WORDS[name], {}, [option("", name === "date" ? "none" : "choose …", !of[name]),
    ...look.columns.filter((one) => one.name).map((one) => option(one.name, one.name, one.name === of[name]))]);
  const unit = look.suggested_unit ?? look.reading.unit;
  const declared = look.reading.time_format;
  const form = (look.problem || !declared ? look.suggested_time_formats[0] : null) ?? declared ?? "";
  const isPattern = form.includes("%");
  const forms = [option("", "ISO 8601 with a zone, or seconds since 1970", !form),
    ...Object.entries(look.time_formats).map(([name, words]) => option(name, `${words} (${name})`, name === form)), option(PATTERN, "another: a pattern", isPattern)];
  return [["time", "date", "bx", "by", "bz"].map(select),
    field("unit", "Unit of the readings", {}, UNITS.map((one) => option(one, one, one === unit))),
    field("nt_per_count", "nT in one count", { type: "number", min: 0, step: "any", value: look.reading.nt_per_count }),
    field("time_format", "Form of the times", {}, forms),
    field("pattern", "Pattern of the times", { placeholder: "%d.%m.%Y %H:%M:%S", value: isPattern ? form : null, maxlength: 100 }),
    field("time_epoch", "They count from (UTC), or year of", { placeholder: "2022-02-19T22:00:00Z", value: look.reading.time_epoch })];
}

// Fields that only some choices need are there only with these.
function tidy(form) {
  const needs = { nt_per_count: form.elements.unit.value === "counts", pattern: form.elements.time_format.value === PATTERN,
    time_epoch: NEEDS_EPOCH.has(form.elements.time_format.value) };
  for (const [name, isNeeded] of Object.entries(needs)) form.elements[name].closest(".field").hidden = !isNeeded;
}

function asItStands(look) {
  if (!look.columns.length) return null;
  return h("div", { class: "scroll", tabindex: "0", role: "region", "aria-label": "First rows as they stand" }, h("table", { class: "look" },
    h("caption", {}, `The first rows as they stand in the ${look.format} table, and what each column is taken for.`),
    h("thead", {}, h("tr", {}, look.columns.map((one) => h("th", { scope: "col" }, one.name || "(no name)"))),
      h("tr", {}, look.columns.map((one) => h("td", { class: one.taken_for ? "taken" : "muted" }, one.taken_for ?? (one.may_be ? `${one.may_be}?` : "kept as it is"))))),
    h("tbody", {}, look.rows.map((row) => h("tr", {}, row.cells.map((cell) => h("td", {}, cell)))))));
}

function asRead({ read, problem }) {
  if (problem) return problemTable({ body: problem });
  return h("div", {}, h("p", { class: "accept" }, h("strong", { class: "badge" }, `● ${fixed(read.samples, 0)} samples`),
    ` ${fixed(read.used, 0)} usable, ${time(read.data_from)} to ${time(read.data_until)} UTC, median |B| ${nt(read.b_median_nt, 0)}`),
  h("div", { class: "scroll", tabindex: "0", role: "region", "aria-label": "First rows as read" }, h("table", {},
    h("caption", {}, "The same rows as they would be kept: UTC, nT, in the base frame."),
    h("thead", {}, h("tr", {}, ["time, UTC", "bx, nT", "by, nT", "bz, nT"].map((name, i) => h("th", { scope: "col", class: i ? "n" : "" }, name)))),
    h("tbody", {}, read.first_times.map((t, i) => h("tr", {}, h("td", {}, t.replace("T", " ").replace("Z", "")),
      read.first_nt[i].map((value) => h("td", { class: "n" }, value === null ? "none" : fixed(value, 1)))))))));
}

// A panel over one file. `send` sends the same file; it resolves once the panel is no longer needed.
export function lookAt({ satellite, magnetometer, file, headers, send }) {
  const [table, read, faults] = [h("div"), h("div", { "aria-live": "polite" }), h("div")];
  const path = `/satellites/${satellite}/magnetometers/${encodeURIComponent(magnetometer.id)}`;
  let [number, form, kept, button] = [0, null, null, null];

  const ask = (choice) => api(`/satellites/${satellite}/sessions/preview?${queryOf(magnetometer.id, choice)}`, { method: "POST", body: file, headers });

  function draw(look) {
    table.replaceChildren(asItStands(look) ?? "");
    read.replaceChildren(asRead(look));
    if (button) button.disabled = look.read === null;
  }

  async function again() {
    const mine = ++number;
    tidy(form);
    try {
      const look = await ask(chosen(form, kept));
      if (mine === number) draw(look);
    } catch (problem) {
      if (mine === number) read.replaceChildren(problemTable(problem));
    }
  }

  async function keep(event) {
    event.preventDefault();
    faults.replaceChildren();
    button.disabled = true;
    try {
      await api(path, { method: "PATCH", json: chosen(form, kept) });
      await send();
    } catch (problem) {
      faults.replaceChildren(problemTable(problem));
      button.disabled = false;
    }
  }

  async function begin() {
    const look = await ask(null);
    kept = look.reading;
    if (may("operate") && look.columns.length) {
      button = h("button", { class: "primary" }, `Keep for ${magnetometer.id} and send`);
      form = h("form", { class: "inline", "aria-label": `How ${file.name} is read`, onsubmit: keep }, choices(look), h("div", { class: "actions" }, button), faults);
      let waiting = null;
      form.addEventListener("input", () => { clearTimeout(waiting); waiting = setTimeout(again, WAIT_MS); });
      node.insertBefore(form, read);
    } else if (look.read) {
      node.append(h("div", { class: "actions" }, h("button", { type: "button", class: "primary", onclick: () => send() }, "Send")));
    } else if (!may("operate")) {
      node.append(h("p", { class: "muted" }, "How its files are read is kept on the magnetometer; a key with the scope operate may change it."));
    }
    draw(look);
    // What was suggested stands in the form already: look again as it says.
    if (form && look.problem) await again();
    else if (form) tidy(form);
  }

  const node = h("div", { class: "panel" }, h("h3", {}, `${file.name}: how it is read`), table, read);
  begin().catch((problem) => read.replaceChildren(problemTable(problem)));
  return node;
}
