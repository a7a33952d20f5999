// One reprocessing: how far it is, what its calibrations came to, and what its sets say beside those in force.
import { ago, api, fixed, grade, h, may, notice, section, short, show, start, state, tiles, time, title } from "./magcal.js";
import { cancel, ENDED, retry } from "./job.js";
import { listing } from "./listing.js";
import { live } from "./live.js";
import { optionWords } from "./options.js";

const id = location.pathname.split("/")[2];
const WORDS = { queued: "queued", running: "running", succeeded: "succeeded", failed: "failed", cancelled: "cancelled" };
const COMPARED = { same: ["accept", "● agrees"], differs: ["refuse", "✕ differs"], cannot_tell: ["weak", "◆ cannot tell"] };
const ACTIVE_MS = 2000;

// A cell a set, kept over redraws: what its comparison came to.
const cells = new Map();
function cellOf(set) {
  if (!cells.has(set)) cells.set(set, h("span", {}, "–"));
  return cells.get(set);
}

const columns = [
  { name: "session", value: (r) => r.session_ids[0], show: (r) => h("a", { href: `/sessions/${r.session_ids[0]}` }, short(r.session_ids[0])) },
  { name: "satellite", value: (r) => r.satellite, show: (r) => [h("a", { href: `/satellites/${r.satellite}` }, r.satellite), ` ${r.magnetometer}`] },
  { name: "state", value: (r) => r.state, show: (r) => state(r.verdict === "refuse" ? "refused" : r.state) },
  { name: "result", value: (r) => r.result?.parameter_set_id ?? r.error?.code ?? "", show: (r) => (r.result?.parameter_set_id
    ? [r.verdict ? [grade(r.verdict), " "] : "", h("a", { href: `/parameter-sets/${r.result.parameter_set_id}` }, `set ${short(r.result.parameter_set_id)}`)]
    : r.error ? h("span", { title: r.error.detail }, r.error.code) : "–") },
  { name: "beside the set in force", value: (r) => (r.result?.parameter_set_id ? cellOf(r.result.parameter_set_id).textContent : ""), show: (r) => (r.result?.parameter_set_id ? cellOf(r.result.parameter_set_id) : "–") },
];

// The set in force of each magnetometer, asked for once a satellite.
function inForce() {
  const known = new Map();
  return async (job) => {
    if (!known.has(job.satellite)) known.set(job.satellite, api(`/overview?satellite=${encodeURIComponent(job.satellite)}`));
    const { items } = await known.get(job.satellite);
    return items.find((row) => row.magnetometer === job.magnetometer)?.active?.id ?? null;
  };
}

async function compareAll(jobs, place) {
  const counts = { same: 0, differs: 0, cannot_tell: 0, none: 0 };
  const activeOf = inForce();
  const made = jobs.filter((job) => job.result?.parameter_set_id);
  const say = (done) => place.replaceChildren(done < made.length ? `Compared ${done} of ${made.length} …`
    : `Of ${made.length}: ${counts.differs} differ from the set in force, ${counts.same} agree, ${counts.cannot_tell} cannot tell${counts.none ? `, ${counts.none} have none to be compared with` : ""}.`);
  for (const [i, job] of made.entries()) {
    say(i);
    const set = job.result.parameter_set_id;
    const active = await activeOf(job);
    if (!active || active === set) {
      counts.none += 1;
      cellOf(set).replaceChildren(active ? "is in force" : "none in force");
      continue;
    }
    const { word } = await api(`/parameter-sets/${set}/comparison?other=${active}`);
    counts[word] += 1;
    cellOf(set).replaceChildren(h("a", { href: `/compare?first=${active}&second=${set}` }, h("span", { class: `badge ${COMPARED[word][0]}` }, COMPARED[word][1])));
  }
  say(made.length);
}

start(async () => {
  title(`Reprocessing ${short(id)}`);
  const top = h("div");
  const said = h("p", { role: "status" });
  let [job, jobs, timer] = [await api(`/jobs/${id}`), [], null];
  const list = listing("/jobs", columns, {
    caption: "Its calibrations", file: `reprocessing-${short(id)}`, sort: "created", given: { parent: id, total: "true" }, empty: "None.",
    facets: [{ name: "state", label: "State", values: WORDS, of: (answer) => answer.counts }],
    changed: (answer) => { jobs = answer.items; head(answer); } });

  function buttons() {
    if (!may("operate")) return null;
    const again = (promise) => promise.then(draw, (problem) => notice(problem.message, "refuse"));
    if (!ENDED.has(job.state)) return h("button", { type: "button", onclick: () => again(cancel(job)) }, "Cancel");
    return h("button", { type: "button", onclick: () => retry(job).then((made) => { location.href = `/reprocessings/${made.id}`; }, (problem) => notice(problem.message, "refuse")) }, "All of it again");
  }

  function head({ counts }) {
    const all = Object.values(counts).reduce((sum, one) => sum + one, 0);
    top.replaceChildren(tiles(["state", state(job.state)], ["progress", [h("progress", { max: 1, value: job.progress, "aria-label": "Progress" }), ` ${fixed(100 * job.progress, 0)} %`]],
      ["calibrations", fixed(all, 0), `${fixed(counts.succeeded ?? 0, 0)} succeeded`], ["failed", fixed(counts.failed ?? 0, 0), counts.cancelled ? `${counts.cancelled} cancelled` : null]),
    h("div", { class: "actions" }, buttons(), h("button", { type: "button", disabled: !counts.succeeded, onclick: () => compareAll(jobs, said).catch((problem) => notice(problem.message, "refuse")) }, "Compare with the sets in force")));
  }

  async function draw() {
    clearTimeout(timer);
    job = await api(`/jobs/${id}`);
    await list.refresh();
    if (!ENDED.has(job.state)) timer = setTimeout(draw, ACTIVE_MS);
  }

  show(h("div", { class: "heading" }, h("h1", {}, `Reprocessing ${short(id)}`), h("p", { class: "muted" }, `begun ${ago(job.created_at)}, ${time(job.created_at)} UTC, with ${optionWords(job.options)}`),
    h("p", {}, h("a", { href: "/reprocessings" }, "All reprocessings"))), top, said, section("Calibrations", list));
  await list.refresh();
  if (ENDED.has(job.state)) return;
  timer = setTimeout(draw, ACTIVE_MS);
  live(draw, { types: ["job.ended"] });
});
