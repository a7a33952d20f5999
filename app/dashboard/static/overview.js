// What needs attention, then the fleet; the first step where there is none. It refreshes itself.
import { lines } from "./attention.js";
import { age, api, counters, field, fixed, form, grade, h, may, nt, show, start, time } from "./magcal.js";
import { listing } from "./listing.js";
import { live } from "./live.js";
import { magnetometerPage } from "./status.js";

const WALL = new URLSearchParams(location.search).get("display") === "wall";
const REFRESH_MS = WALL ? 5000 : 10000;
const MOST_LINES = WALL ? 30 : 100;
const AGREEMENTS = { disagrees: "refuse", watch: "weak", agrees: "accept", too_short: "", not_judged: "" };
const WORDS = { disagrees: "✕ disagrees", watch: "◆ watch", agrees: "● agrees", too_short: "too short", not_judged: "not judged" };
const STATES = { act: "refuse", watch: "weak", good: "accept" };

const times = (ratio) => (ratio === null || ratio === undefined ? "" : ` (${fixed(ratio, ratio < 10 ? 1 : 0)} times)`);
// How many causes there are in all, of which the worst names the state.
const of = (causes) => (causes > 1 ? `, ${causes} causes` : "");

const COLUMNS = [
  { name: "satellite", sort: "name", value: (r) => r.satellite, show: (r) => [h("a", { class: "named", href: `/satellites/${r.satellite}` }, r.name ?? r.satellite),
    r.name && r.name !== r.satellite ? h("small", {}, r.satellite) : null] },
  { name: "magnetometer", value: (r) => r.magnetometer, show: (r) => (r.magnetometer ? h("a", { href: magnetometerPage(r.satellite, r.magnetometer) }, r.magnetometer) : "–") },
  { name: "state", sort: "worst", value: (r) => r.state, show: (r) => h("span", { class: `badge ${STATES[r.state]}` },
    { act: `✕ to do${of(r.attention)}`, watch: `◆ to watch${of(r.attention)}`, good: "● good" }[r.state]) },
  { name: "set in force", sort: "verdict", value: (r) => r.verdict, show: (r) => r.parameter_set_id
    ? h("a", { href: `/parameter-sets/${r.parameter_set_id}` }, grade(r.verdict)) : h("span", { class: "muted" }, "none") },
  { name: "newest data", numeric: true, sort: "data_until", value: (r) => r.data_until, show: (r) => r.session_id
    ? h("a", { href: `/sessions/${r.session_id}`, title: time(r.data_until) }, age(r.data_until)) : "–" },
  { name: "agrees with it", value: (r) => r.agreement, show: (r) => r.agreement
    ? h("span", { class: `badge ${AGREEMENTS[r.agreement]}` }, WORDS[r.agreement]) : "–" },
  { name: "its residual", numeric: true, sort: "residual_nt", value: (r) => r.residual_nt, show: (r) => (r.residual_nt === null ? "–"
    : h("span", { class: `residual ${AGREEMENTS[r.agreement]}` }, nt(r.residual_nt), times(r.residual_ratio))) },
  { name: "orbit", numeric: true, value: (r) => r.orbit_epoch, show: (r) => h("span", { title: time(r.orbit_epoch) }, age(r.orbit_epoch)) },
  { name: "last failure", value: (r) => r.last_failure?.code, show: (r) => (r.last_failure
    ? h("a", { href: `/jobs?q=${r.last_failure.job_id}`, title: r.last_failure.detail ?? "" }, `${r.last_failure.code ?? "failed"}, ${age(r.last_failure.at)}`)
    : r.is_calibrating ? "calibrating …" : "–") },
];

const FACETS = [
  { name: "state", label: "State", values: { act: "to do", watch: "to watch", good: "good" }, of: (answer) => answer.facets.state },
  { name: "verdict", label: "Set in force", values: { refuse: "refuse", weak: "weak", accept: "accept", none: "none" }, of: (answer) => answer.facets.verdict },
  { name: "agreement", label: "Newest session", values: { disagrees: "disagrees", watch: "watch", agrees: "agrees", too_short: "too short", not_judged: "not judged", none: "no judgement" },
    of: (answer) => answer.facets.agreement },
];

function addSatellite() {
  return form([
    field("id", "Id (lower case)", { required: true, pattern: "[a-z0-9][a-z0-9._\\-]{0,62}", placeholder: "dekart" }),
    field("name", "Name", { placeholder: "DEKART" }),
    field("norad_id", "NORAD id", { placeholder: "46493" }),
  ], "Add satellite", async (values) => {
    const given = Object.fromEntries(Object.entries(values).filter(([, value]) => value));
    await api("/satellites", { method: "POST", json: given });
    location.href = `/satellites/${values.id}`;
  });
}

function welcome(satellites) {
  show(h("h1", {}, "Welcome to magcal"), h("div", { class: "empty" },
    satellites.length ? [h("h2", {}, "Next step: add a magnetometer"), h("ul", {}, satellites.map((one) => h("li", {}, h("a", { href: `/satellites/${one.id}` }, one.name ?? one.id))))]
      : h("h2", {}, "First step: add a satellite"),
    h("ol", {}, h("li", {}, "Add the satellite, then its magnetometer with its unit."),
      h("li", {}, "Give it an orbit: a TLE is enough."),
      h("li", {}, "Drop a telemetry file on its page and start a calibration. The verdict comes with its reasons.")),
    may("operate") ? addSatellite() : h("p", { class: "muted" }, "Your key may not add satellites; ask for one with the scope operate."),
    h("p", { class: "muted" }, "To see a whole mission first, stop the service and run ", h("code", {}, "magcal demo"), ".")));
}

start(async () => {
  const place = h("div");
  const names = new Map();
  let drawn = "";
  async function attention() {
    const answer = await api(`/attention?limit=${MOST_LINES}&total=true`);
    counters(answer.counts);
    const text = JSON.stringify([answer, [...names]]);
    if (text !== drawn && !place.querySelector("details[open]")) place.replaceChildren(...lines(answer, again, { names }).filter(Boolean));
    drawn = text;
  }
  const fleet = listing("/fleet", COLUMNS, { caption: "Satellites", file: "satellites", facets: WALL ? [] : FACETS, sort: "worst", empty: "None fits.",
    changed: ({ items }) => items.forEach((row) => { if (row.name) names.set(row.satellite, row.name); }) });
  async function again() {
    await fleet.refresh();
    await attention();
  }
  const first = await api("/fleet?limit=1");
  if (!first.total) {
    welcome((await api("/satellites?limit=100")).items);
    return;
  }
  const updated = h("p", { class: "muted", id: "updated" });
  const stamp = () => { updated.textContent = `Updated ${new Date().toISOString().slice(11, 19)} UTC`; };
  document.body.classList.toggle("wall", WALL);
  await again();
  show(h("div", { class: "heading" }, h("h1", {}, WALL ? "magcal" : "Needs attention"), updated,
    h("p", {}, WALL ? h("a", { href: "/" }, "Leave the wall display") : h("a", { href: "/?display=wall" }, "Wall display"))), place,
    h("h2", { id: "fleet" }, "Fleet"), fleet,
    may("operate") && !WALL ? h("details", {}, h("summary", {}, "Add a satellite"), addSatellite()) : null);
  stamp();
  live(() => again().then(stamp, () => { updated.textContent = "The service does not answer."; }), { lostMs: REFRESH_MS });
});
