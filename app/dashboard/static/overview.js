// Every satellite with its state at a glance; the first step where there is none.
import { age, api, field, form, grade, h, may, notice, nt, section, show, start, time } from "./magcal.js";
import { table } from "./table.js";

const COLUMNS = [
  { name: "satellite", value: (r) => r.satellite, show: (r) => h("a", { href: `/satellites/${r.satellite}` }, r.satellite) },
  { name: "magnetometer", value: (r) => r.magnetometer },
  { name: "active set", value: (r) => r.active?.grade, show: (r) => r.active
    ? h("a", { href: `/parameter-sets/${r.active.id}` }, grade(r.active.grade)) : h("span", { class: "muted" }, "none") },
  { name: "data's age", numeric: true, value: (r) => r.active && Date.parse(r.active.data_until), show: (r) => age(r.active?.data_until) },
  { name: "in force since", value: (r) => r.active?.activated_at, show: (r) => time(r.active?.activated_at) },
  { name: "residual", numeric: true, value: (r) => r.active?.rms_nt, show: (r) => nt(r.active?.rms_nt) },
  { name: "last session", value: (r) => r.last_session?.data_until, show: (r) => r.last_session
    ? h("a", { href: `/sessions/${r.last_session.id}` }, time(r.last_session.data_until)) : "–" },
  { name: "its residual under the active set", numeric: true, value: (r) => r.under_active, show: underActive },
  { name: "newest set", value: (r) => r.newest?.grade, show: (r) => r.newest && r.newest.id !== r.active?.id
    ? [h("a", { href: `/parameter-sets/${r.newest.id}` }, grade(r.newest.grade)), ` ${r.newest.status}`] : "–" },
  { name: "jobs", numeric: true, value: (r) => r.jobs_waiting, show: (r) => r.jobs_waiting ? h("a", { href: `/jobs` }, r.jobs_waiting) : "0" },
];

// Asked for one row at a time, after the table is there: it needs the samples of the session.
function underActive(row) {
  const cell = h("span", {}, "…");
  if (!row.active || !row.last_session) return "–";
  if (row.under_active !== undefined) return nt(row.under_active);
  api(`/sessions/${row.last_session.id}/residual?parameter_set=${row.active.id}`)
    .then((found) => { row.under_active = found.rms_nt; cell.textContent = nt(found.rms_nt); })
    .catch((problem) => { row.under_active = null; cell.textContent = "–"; cell.title = problem.message; });
  return cell;
}

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

start(async () => {
  const { items } = await api("/overview?limit=1000");
  if (!items.length) {
    show(h("h1", {}, "Welcome to magcal"), h("div", { class: "empty" },
      h("h2", {}, "First step: add a satellite"),
      h("ol", {}, h("li", {}, "Add the satellite, then its magnetometer with its unit."),
        h("li", {}, "Give it an orbit: a TLE is enough."),
        h("li", {}, "Drop a telemetry file on its page and start a calibration. The verdict comes with its reasons.")),
      may("operate") ? addSatellite() : h("p", { class: "muted" }, "Your key may not add satellites; ask for one with the scope operate."),
      h("p", { class: "muted" }, "To see a whole mission first, stop the service and run ", h("code", {}, "magcal demo"), ".")));
    return;
  }
  const count = new Set(items.map((row) => row.satellite)).size;
  show(h("h1", {}, "Satellites"), table(COLUMNS, items, { caption: "Satellites", file: "satellites" }),
    may("operate") ? h("details", {}, h("summary", {}, "Add a satellite"), addSatellite()) : null);
  if (count >= 1000) notice("Only the first 1,000 satellites are shown.");
});
