// The queue, live: progress, cancel, retry.
import { ago, h, listed, may, notice, painted, short, show, start, state, time } from "./magcal.js";
import { cancel, ENDED, retry, watch } from "./job.js";
import { table } from "./table.js";

const MOST_WATCHED = 4; // browsers keep six connections to one server
const FIRST = 50;
const MOST = 500;

function result(job) {
  if (job.result?.parameter_set_id) return h("a", { href: `/parameter-sets/${job.result.parameter_set_id}` }, `set ${short(job.result.parameter_set_id)}`);
  if (job.error) return h("details", {}, h("summary", {}, job.error.code), job.error.detail);
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
  { name: "job", value: (r) => r.id, show: (r) => short(r.id) },
  { name: "kind", value: (r) => r.kind },
  { name: "state", value: (r) => r.state, show: (r) => state(r.state) },
  { name: "progress", numeric: true, value: (r) => r.progress, show: (r) => r.state === "failed" || r.state === "cancelled" ? "–" : h("progress", { max: 1, value: r.progress, "aria-label": `Progress of ${short(r.id)}` }) },
  { name: "satellite", value: (r) => r.satellite, show: (r) => r.satellite ? h("a", { href: `/satellites/${r.satellite}` }, r.satellite) : "–" },
  { name: "session", value: (r) => r.session_ids[0], show: (r) => r.session_ids.length ? h("a", { href: `/sessions/${r.session_ids[0]}` }, short(r.session_ids[0]),
    r.session_ids.length > 1 ? ` and ${r.session_ids.length - 1} more` : "") : "–" },
  { name: "method", value: (r) => r.options.method ?? "" },
  { name: "created", value: (r) => r.created_at, show: (r) => h("span", { title: time(r.created_at) }, ago(r.created_at)) },
  { name: "attempts", numeric: true, value: (r) => r.attempts },
  { name: "result", value: (r) => r.result?.parameter_set_id ?? r.error?.code ?? "", show: result },
  { name: "action", value: () => "", show: (r) => actions(r, again) },
];

start(async () => {
  const place = h("div");
  let sources = [];
  let timer = null;
  let known = "";
  async function draw(most = MOST) {
    clearTimeout(timer);
    sources.forEach((source) => source.close());
    const jobs = await listed("/jobs", most);
    const isRead = place.querySelector("details[open]") && known === JSON.stringify(jobs);
    known = JSON.stringify(jobs);
    if (place.firstChild?.renew && !isRead) place.firstChild.renew(jobs);
    else if (!isRead) place.replaceChildren(table(columns(() => draw()), jobs, { caption: "Jobs", file: "jobs", empty: "No job yet. A calibration is started on a session's page." }));
    const active = jobs.filter((job) => !ENDED.has(job.state));
    sources = active.slice(0, MOST_WATCHED).map((job) => {
      let last = job.state;
      return watch(job.id, (now) => {
        const bar = place.querySelector(`progress[aria-label="Progress of ${short(now.id)}"]`);
        if (bar) bar.value = now.progress;
        if (now.state !== last) { last = now.state; draw(); }
      });
    });
    timer = setTimeout(draw, active.length > MOST_WATCHED ? 3000 : 10000);
  }
  show(h("h1", {}, "Jobs"), place);
  await draw(FIRST);
  await painted();
  await draw();
});
