// The queue, live: searched, filtered and counted by the service; progress, cancel, retry.
import { ago, causes, grade, h, may, notice, short, show, start, state, time } from "./magcal.js";
import { cancel, ENDED, retry } from "./job.js";
import { listing } from "./listing.js";
import { live } from "./live.js";

const WORDS = { queued: "queued", running: "running", succeeded: "succeeded", failed: "failed", cancelled: "cancelled" };
const ACTIVE_MS = 2000;
const IDLE_MS = 10000;

function result(job) {
  const set = job.result?.parameter_set_id;
  if (set && job.verdict) return [grade(job.verdict), " ", h("a", { href: `/parameter-sets/${set}` }, `set ${short(set)}`)];
  if (set) return h("a", { href: `/parameter-sets/${set}` }, `set ${short(set)}`);
  if (job.error) return h("details", {}, h("summary", {}, job.error.code), job.error.detail, causes(job.error.diagnosis));
  return "–";
}

function actions(job, again) {
  if (!may("operate")) return "";
  if (!ENDED.has(job.state)) {
    return h("button", { type: "button", onclick: async () => { await cancel(job).catch((p) => notice(p.message, "refuse")); again(); } }, "Cancel");
  }
  return job.state === "succeeded" ? "" : h("button", { type: "button", onclick: async () => {
    await retry(job).then((made) => notice(`Queued again as ${short(made.id)}.`, "accept"), (p) => notice(p.message, "refuse"));
    again();
  } }, "Retry");
}

const columns = (again) => [
  { name: "job", sort: "created", value: (r) => r.id, show: (r) => [short(r.id), h("small", { title: time(r.created_at) }, ago(r.created_at))] },
  { name: "state", value: (r) => r.state, show: (r) => [state(r.verdict === "refuse" ? "refused" : r.state),
    r.state === "running" ? h("progress", { max: 1, value: r.progress, "aria-label": `Progress of ${short(r.id)}` }) : null] },
  { name: "result", value: (r) => r.result?.parameter_set_id ?? r.error?.code ?? "", show: result },
  { name: "action", value: () => "", show: (r) => actions(r, again) },
  { name: "satellite", value: (r) => r.satellite, show: (r) => (r.satellite ? h("a", { href: `/satellites/${r.satellite}` }, r.satellite) : "–") },
  { name: "magnetometer", value: (r) => r.magnetometer },
  { name: "kind", value: (r) => r.kind, show: (r) => [r.kind, r.options.method ? h("small", {}, r.options.method) : null] },
  { name: "session", value: (r) => r.session_ids[0], show: (r) => (r.session_ids.length ? [h("a", { href: `/sessions/${r.session_ids[0]}` }, short(r.session_ids[0])),
    r.session_ids.length > 1 ? ` and ${r.session_ids.length - 1} more` : ""] : "–") },
  { name: "attempts", numeric: true, value: (r) => r.attempts },
];

start(async () => {
  let timer = null;
  let isActive = false;
  const list = listing("/jobs", columns(() => draw()), {
    caption: "Jobs", file: "jobs", sort: "-created", given: { total: "true" }, empty: "No job yet. A calibration is started on a session's page.",
    facets: [{ name: "state", label: "State", values: WORDS, of: (answer) => answer.counts }],
    changed: (answer) => { isActive = Boolean(answer.counts.queued || answer.counts.running); },
  });
  async function draw() {
    clearTimeout(timer);
    await list.refresh();
    timer = setTimeout(() => (document.hidden ? (timer = setTimeout(draw, IDLE_MS)) : draw()), isActive ? ACTIVE_MS : IDLE_MS);
  }
  show(h("h1", {}, "Jobs"), list);
  await draw();
  live(draw, { types: ["job.ended", "session.received"] });
});
