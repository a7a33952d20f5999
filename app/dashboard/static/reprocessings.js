// Whole histories calibrated anew: those there are, with their progress, and a form that starts one.
import { ago, api, confirm, field, fixed, form, h, listed, may, notice, option, section, short, show, start, state, time } from "./magcal.js";
import { cancel, ENDED } from "./job.js";
import { listing } from "./listing.js";
import { live } from "./live.js";
import { optionFields, optionsOf, optionWords } from "./options.js";

const ACTIVE_MS = 3000;
const IDLE_MS = 15000;

const actions = (job, again) => (may("operate") && !ENDED.has(job.state)
  ? h("button", { type: "button", "aria-label": `Cancel ${short(job.id)}`, onclick: () => cancel(job).then(again, (problem) => notice(problem.message, "refuse")) }, "Cancel") : "");

const columns = (again) => [
  { name: "reprocessing", sort: "created", value: (r) => r.id, show: (r) => [h("a", { href: `/reprocessings/${r.id}` }, short(r.id)), h("small", { title: time(r.created_at) }, ago(r.created_at))] },
  { name: "state", value: (r) => r.state, show: (r) => state(r.state) },
  { name: "progress", numeric: true, value: (r) => r.progress, show: (r) => [h("progress", { max: 1, value: r.progress, "aria-label": `Progress of ${short(r.id)}` }), ` ${fixed(100 * r.progress, 0)} %`] },
  { name: "satellite", value: (r) => r.satellite, show: (r) => (r.satellite ? h("a", { href: `/satellites/${r.satellite}` }, r.satellite) : "several") },
  { name: "options", value: (r) => optionWords(r.options) },
  { name: "priority", numeric: true, value: (r) => r.priority },
  { name: "action", value: () => "", show: (r) => actions(r, again) },
];

const instant = (text, isEnd) => (text.trim() ? (/^\d{4}-\d\d-\d\d$/.test(text.trim()) ? `${text.trim()}T${isEnd ? "23:59:59" : "00:00:00"}Z` : text.trim()) : null);

function bodyOf(values) {
  const body = { priority: Number(values.priority || -50), ...optionsOf(values) };
  if (values.satellite) body.satellites = [values.satellite];
  if (values.magnetometer.trim()) body.magnetometer = values.magnetometer.trim();
  for (const name of ["since", "until"]) if (values[name].trim()) body[name] = instant(values[name], name === "until");
  return body;
}

async function count(body) {
  const query = new URLSearchParams({ limit: 1, total: "true", state: "closed" });
  if (body.satellites) query.set("satellite", body.satellites[0]);
  for (const name of ["magnetometer", "since", "until"]) if (body[name]) query.set(name, body[name]);
  return (await api(`/sessions?${query}`)).total;
}

function starter(satellites) {
  return form([
    field("satellite", "Satellite", {}, [option("", "all that the key reaches"), ...satellites.map((one) => option(one.id, one.name ?? one.id))]),
    field("magnetometer", "Magnetometer", { placeholder: "all", maxlength: 63 }),
    field("since", "Sessions since, UTC", { placeholder: "2022-01-01" }), field("until", "until, UTC", { placeholder: "now" }),
    field("priority", "Priority: below 0, so that a pass goes first", { type: "number", min: -100, max: 100, step: 1, value: -50 }),
    optionFields(),
  ], "Reprocess …", async (values) => {
    const body = bodyOf(values);
    const sessions = await count(body);
    if (!await confirm("Reprocess", h("p", {}, `${fixed(sessions, 0)} session${sessions === 1 ? "" : "s"} will be calibrated anew, with ${optionWords(optionsOf(values))}. What is in force stays in force; each new set is a candidate.`), "Reprocess")) return;
    const job = await api("/reprocessings", { method: "POST", json: body });
    location.href = `/reprocessings/${job.id}`;
  });
}

start(async () => {
  let [timer, isActive] = [null, false];
  const list = listing("/jobs", columns(() => draw()), {
    caption: "Reprocessings", file: "reprocessings", sort: "-created", given: { kind: "reprocessing", total: "true" }, empty: "None yet.",
    changed: (answer) => { isActive = answer.items.some((job) => !ENDED.has(job.state)); } });
  async function draw() {
    clearTimeout(timer);
    await list.refresh();
    timer = setTimeout(draw, isActive && !document.hidden ? ACTIVE_MS : IDLE_MS);
  }
  show(h("h1", {}, "Reprocessing"), h("p", { class: "muted" }, "Every closed session of a history calibrated anew, after an update or with other options. Sets in force stay in force until somebody activates others."), list,
    may("operate") ? section("Start one", starter(await listed("/satellites", 1000))) : null);
  await draw();
  live(draw, { types: ["job.ended"] });
});
