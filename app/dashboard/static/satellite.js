// One satellite: state, history, sessions, parameter sets, orbits, upload.
import { age, agreement, AGREEMENTS, AGREEMENT_SIGNS, api, field, fixed, form, grade, h, listed, may, notice, nt, option, painted, section, short, show, start, tiles, time, title } from "./magcal.js";
import { lines } from "./attention.js";
import { live } from "./live.js";
import { notes } from "./notes.js";
import { plot, replot } from "./plot.js";
import { statusOf } from "./status.js";
import { table } from "./table.js";
import { uploader } from "./upload.js";

const id = decodeURIComponent(location.pathname.split("/")[2]);
const UNITS = ["nT", "uT", "mT", "T", "G", "mG"];

const SESSION_COLUMNS = [
  { name: "session", value: (r) => r.id, show: (r) => h("a", { href: `/sessions/${r.id}` }, short(r.id)) },
  { name: "magnetometer", value: (r) => r.magnetometer },
  { name: "from", value: (r) => r.data_from, show: (r) => time(r.data_from) },
  { name: "until", value: (r) => r.data_until, show: (r) => time(r.data_until) },
  { name: "samples", numeric: true, value: (r) => r.samples },
  { name: "used", numeric: true, value: (r) => r.used_samples },
  { name: "verdict of its newest set", value: (r) => r.grade, show: (r) => r.grade ? h("a", { href: `/parameter-sets/${r.set_id}` }, grade(r.grade)) : "–" },
  { name: "agrees with the set in force", value: (r) => r.monitoring?.grade, show: (r) => (r.monitoring ? agreement(r.monitoring) : "–") },
  { name: "received", value: (r) => r.created_at, show: (r) => time(r.created_at) },
];

const MOST_NAMED = 3;

function listOf(sessions) {
  const named = sessions.slice(0, MOST_NAMED).map((one, i) => [i ? ", " : "", h("a", { href: `/sessions/${one}` }, short(one))]);
  return h("span", {}, named, sessions.length > MOST_NAMED ? ` and ${sessions.length - MOST_NAMED} more` : "");
}

export const SET_COLUMNS = [
  { name: "parameter set", value: (r) => r.id, show: (r) => h("a", { href: `/parameter-sets/${r.id}` }, short(r.id)) },
  { name: "status", value: (r) => r.status, show: (r) => r.status === "active" ? h("strong", {}, "active") : r.status },
  { name: "verdict", value: (r) => r.grade, show: (r) => grade(r.grade) },
  { name: "magnetometer", value: (r) => r.magnetometer },
  { name: "method", value: (r) => r.method },
  { name: "data from", value: (r) => r.data_from, show: (r) => time(r.data_from) },
  { name: "RMS before, nT", numeric: true, value: (r) => r.rms_before_nt, show: (r) => fixed(r.rms_before_nt) },
  { name: "after", numeric: true, value: (r) => r.rms_nt, show: (r) => fixed(r.rms_nt) },
  { name: "cross-validated", numeric: true, value: (r) => r.cross_validated_rms_nt, show: (r) => fixed(r.cross_validated_rms_nt) },
  { name: "orbit's age, d", numeric: true, value: (r) => r.orbit_age_days, show: (r) => fixed(r.orbit_age_days, 2) },
  { name: "samples", numeric: true, value: (r) => r.samples },
  { name: "sessions", value: (r) => r.session_ids.join(" "), show: (r) => listOf(r.session_ids) },
  { name: "options", value: (r) => r.options, show: (r) => r.options || "–" },
  { name: "created", value: (r) => r.created_at, show: (r) => time(r.created_at) },
];

const ORBIT_COLUMNS = (own, again) => [
  { name: "epoch", value: (r) => r.epoch, show: (r) => time(r.epoch) },
  { name: "format", value: (r) => r.format },
  { name: "name", value: (r) => r.name },
  { name: "NORAD id", value: (r) => r.details.norad_id, show: (r) => (isOther(r, own) ? h("strong", { class: "badge refuse" }, `✕ ${r.details.norad_id}, not ${own}`) : r.details.norad_id ?? "–") },
  { name: "received", value: (r) => r.created_at, show: (r) => time(r.created_at) },
  { name: "in use", value: (r) => (r.withdrawn_at ? "withdrawn" : "yes"), show: (r) => orbitUse(r, again) },
];

const plain = (norad) => String(norad).replace(/^0+/, "");
const isOther = (orbit, own) => Boolean(own && orbit.details.norad_id && plain(orbit.details.norad_id) !== plain(own));

function orbitUse(orbit, again) {
  const verb = orbit.withdrawn_at ? "restore" : "withdraw";
  const change = async () => {
    await api(`/satellites/${id}/orbits/${orbit.id}/${verb}`, { method: "POST" }).catch((problem) => notice(problem.message, "refuse"));
    again();
  };
  const label = `${orbit.withdrawn_at ? "Restore" : "Withdraw"} the orbit of ${time(orbit.epoch)}`;
  return [orbit.withdrawn_at ? "withdrawn " : "yes ", may("operate") ? h("button", { type: "button", class: "quiet", "aria-label": label, onclick: change }, orbit.withdrawn_at ? "Restore" : "Withdraw") : null];
}

function settings(satellite) {
  const limit = (name, label, unset) => field(name, label, { type: "number", min: 0, step: "any", placeholder: unset, value: satellite[name] });
  return form([
    field("name", "Name", { value: satellite.name }), field("norad_id", "NORAD id", { value: satellite.norad_id }),
    limit("data_stale_days", "Newest reading may be so old, days", "30"), limit("orbit_stale_days", "Newest orbit may be so old, days", "7"),
    limit("station_silent_hours", "Nothing may have arrived for so long, h", "72"),
  ], "Change", async (values) => {
    const number = (text) => (text === "" ? null : Number(text));
    const json = { name: values.name || null, norad_id: values.norad_id || null };
    for (const name of ["data_stale_days", "orbit_stale_days", "station_silent_hours"]) json[name] = number(values[name]);
    await api(`/satellites/${id}`, { method: "PATCH", json });
    location.reload();
  });
}

// The sessions as a strip over time: agrees, watch, disagrees with the set that was in force when they were judged.
function strip(sessions) {
  const judged = sessions.filter((one) => one.monitoring).slice(0, 120).reverse();
  if (!judged.length) return null;
  return h("div", { class: "strip", role: "group", "aria-label": "Sessions over time, and whether each agrees with the set in force" },
    judged.map((one) => h("a", { class: `badge ${AGREEMENTS[one.monitoring.grade]}`, href: `/sessions/${one.id}`, title: `${time(one.data_until)}: ${one.monitoring.grade}`,
      "aria-label": `${time(one.data_until)}: ${one.monitoring.grade}` }, AGREEMENT_SIGNS[one.monitoring.grade])));
}

function addMagnetometer() {
  return form([
    field("id", "Id", { required: true, pattern: "[a-z0-9][a-z0-9._\\-]{0,62}", placeholder: "mgm-1" }),
    field("unit", "Unit of its readings", {}, UNITS.map((unit) => option(unit))),
    field("noise_nt", "Noise, nT (1 sigma)", { type: "number", min: 0, step: "any" }),
    field("integration_s", "Averages a reading over, s", { type: "number", min: 0, max: 60, step: "any" }),
    field("range_nt", "Range, nT", { type: "number", min: 0, step: "any" }),
    field("columns", "Column names (JSON, magcal → yours)", { placeholder: '{"time": "ts", "bx": "mag_x"}' }),
  ], "Add magnetometer", async (values) => {
    const body = { id: values.id, unit: values.unit };
    if (values.noise_nt) body.noise_nt = Number(values.noise_nt);
    if (values.integration_s) body.integration_s = Number(values.integration_s);
    if (values.range_nt) body.range_nt = Number(values.range_nt);
    if (values.columns) body.columns = parsed(values.columns);
    await api(`/satellites/${id}/magnetometers`, { method: "POST", json: body });
    location.reload();
  });
}

function parsed(text) {
  try {
    return JSON.parse(text);
  } catch {
    throw new Error("the column names are not valid JSON");
  }
}

function addOrbit() {
  return form([
    field("content", "TLE or 3LE, OMM, OEM, or a state vector", { rows: 4, required: true, spellcheck: "false",
      placeholder: "1 46493U 20068R   22050.…\n2 46493  97.7…" }),
  ], "Add orbit", async ({ content }, node) => {
    const first = content.trim()[0];
    const kind = first === "{" || first === "[" ? "application/json" : first === "<" ? "application/xml" : "text/plain";
    const { items } = await api(`/satellites/${id}/orbits`, { method: "POST", body: content, headers: { "Content-Type": kind } });
    notice(`${items.length} orbit${items.length > 1 ? "s" : ""} kept, epoch ${time(items[0].epoch)}.`, "accept");
    node.reset();
    document.dispatchEvent(new Event("orbits"));
  });
}

// Which trend to ask for: three sets that can count are needed, and a time that is not too far from them.
function trendOf(sets, magnetometer) {
  const own = sets.filter((row) => row.magnetometer === magnetometer && row.grade !== "refuse");
  const lead = own.find((row) => row.status === "active") ?? own.toSorted((a, b) => a.data_until.localeCompare(b.data_until)).at(-1);
  const counted = own.filter((row) => row.method.startsWith("vector") === lead.method.startsWith("vector"));
  const times = [...new Set(counted.map((row) => row.data_from))].map((text) => Date.parse(text)).sort((a, b) => a - b);
  if (times.length < 3) return null;
  const reach = Math.max(3 * (times.at(-1) - times[0]), 3 * 86400000);
  const now = new Date();
  return now - times.at(-1) < reach ? `?at=${now.toISOString().slice(0, 13)}:00:00Z` : "";
}

async function lives(sets, names, place) {
  for (const magnetometer of names) {
    const tile = [...document.querySelectorAll("[data-life]")].find((node) => node.dataset.life === magnetometer);
    const query = sets.some((row) => row.magnetometer === magnetometer && row.grade !== "refuse") ? trendOf(sets, magnetometer) : null;
    if (query === null || !tile) continue;
    try {
      const { life, at, field_error_nt: error } = await api(`/satellites/${id}/magnetometers/${encodeURIComponent(magnetometer)}/trend${query}`);
      tile.replaceChildren(life.days === null ? "unknown" : `${life.is_capped ? "≥ " : ""}${fixed(life.days, 0)} d`,
        h("small", {}, life.days === null ? life.text : `to within ${fixed(100 * life.share, 0)} %, from ${time(at)}`));
      place.append(plot(`/satellites/${id}/figures/trend?magnetometer=${encodeURIComponent(magnetometer)}`,
        `Trend of ${magnetometer}: ${life.text}`,
        `Points: sets with 95 % bars, hollow where left out; line and band: what all of them tell, on to the end of the life; hatched: jumps. Below, the bound of the active set's error against its limit. Now the field is known to ${nt(error)}.`, 860));
    } catch (problem) {
      tile.replaceChildren("unknown", h("small", {}, problem.message));
    }
  }
}

function historyOf(magnetometer, hasSets) {
  const place = h("div");
  const query = () => `magnetometer=${encodeURIComponent(magnetometer.value)}`;
  const address = (name) => `/satellites/${id}/figures/${name}?${query()}`;
  const figures = hasSets ? [
    plot(address("history"), "Bias, scale and angles over time", "Bars are one honest standard error; ● accept, ◆ weak, ✕ refuse; the line joins sets in order of their data.", 600),
    h("div", { class: "pair" },
      plot(address("residual"), "Residual over time", "Residual RMS of each set in its fit, marked by its verdict, and cross-validated.", 280),
      plot(address("orbit-age"), "Age of the orbit", "Called old from 3 days on, refused from 14 days on: dotted, where the axis reaches that far.", 280)),
    plot(address("sessions"), "Sessions and activations", "Each session by the verdict of its newest set; bars show which set was in force.", 240),
  ] : [];
  magnetometer.addEventListener("change", () => {
    ["history", "residual", "orbit-age", "sessions"].forEach((name, i) => replot(place.querySelectorAll("figure")[i], address(name)));
  });
  const choice = magnetometer.length > 1 ? h("p", { class: "choice" }, h("label", {}, "of magnetometer ", magnetometer)) : null;
  if (figures.length) place.append(section("History", choice, ...figures));
  return place;
}

// Draws a table under the heading of its place, and later other rows in the same table, sorted and filtered as it is.
function renewed(place) {
  let drawn = null;
  return (rows, draw) => {
    if (drawn?.renew && rows.length) {
      drawn.renew(rows);
      return;
    }
    const nodes = draw(rows);
    drawn = nodes.at(-1);
    place.replaceChildren(place.firstChild, ...nodes);
  };
}

start(async () => {
  title(id);
  const [satellite, { items: states }] = await Promise.all([api(`/satellites/${id}`), api(`/overview?satellite=${id}`)]);
  const names = satellite.magnetometers.map((one) => one.id);
  const magnetometer = h("select", {}, names.map((name) => option(name)));
  const sessionsPlace = section("Sessions", h("p", { class: "muted" }, "Loading …"));
  const orbitsPlace = section("Orbits", h("p", { class: "muted" }, "Loading …"));
  const setsPlace = section("Parameter sets", h("p", { class: "muted" }, "Loading …"));
  const trendPlace = h("div");
  const attentionPlace = h("div");
  const attention = () => api(`/attention?satellite=${encodeURIComponent(id)}&total=true`).then(
    (answer) => attentionPlace.replaceChildren(...lines(answer, attention, { names: new Map([[id, satellite.name ?? id]]) }).filter(Boolean)));
  show(h("div", { class: "heading" }, h("h1", {}, satellite.name ?? satellite.id), h("p", { class: "muted" },
    [satellite.id, satellite.norad_id && `NORAD ${satellite.norad_id}`, satellite.cospar_id].filter(Boolean).join(" · ")),
    names.length > 1 ? h("p", {}, h("a", { href: `/satellites/${id}/magnetometers` }, "Magnetometers beside each other")) : null),
    attentionPlace, states.filter((row) => row.magnetometer).map(statusOf),
    !names.length ? h("div", { class: "empty" }, h("h2", {}, "Next step: add its magnetometer"), may("operate") ? addMagnetometer() : null) : null,
    names.length && may("ingest") ? section("Upload telemetry", uploader(id, satellite.magnetometers, () => { tables(); attention(); })) : null,
    setsPlace, trendPlace, historyOf(magnetometer, states.some((row) => row.newest)), sessionsPlace, orbitsPlace, notes(`/satellites/${id}`),
    may("operate") ? h("details", {}, h("summary", {}, "Settings of the satellite"), settings(satellite)) : null,
    names.map((name) => h("details", {}, h("summary", {}, `Notes on magnetometer ${name}`), notes(`/satellites/${id}/magnetometers/${name}`))),
    may("operate") && names.length ? h("details", {}, h("summary", {}, "Add a magnetometer"), addMagnetometer()) : null);

  async function orbits() {
    const rows = await listed(`/satellites/${id}/orbits`, 1000);
    orbitsPlace.replaceChildren(orbitsPlace.firstChild, table(ORBIT_COLUMNS(satellite.norad_id, () => { orbits(); attention(); }), rows, { caption: "Orbits", file: `${id}-orbits`,
      empty: "No orbit yet. Telemetry without positions or a reference field needs one: paste a TLE." }),
      may("ingest", "operate") ? h("details", { open: !rows.length }, h("summary", {}, "Add an orbit"), addOrbit()) : "");
  }
  document.addEventListener("orbits", orbits);
  attention();
  await painted();
  const [setsTable, sessionsTable, stripPlace] = [renewed(setsPlace), renewed(sessionsPlace), h("div")];
  async function tables() {
    const [sets, sessions] = await Promise.all([listed(`/satellites/${id}/history`, 1000), listed(`/sessions?satellite=${id}`, 1000)]);
    const newestOf = new Map([...sets].reverse().flatMap((row) => row.session_ids.map((one) => [one, row])));
    for (const session of sessions) {
      const newest = newestOf.get(session.id);
      session.grade = newest?.grade;
      session.set_id = newest?.id;
    }
    stripPlace.replaceChildren(strip(sessions) ?? "");
    sessionsTable(sessions, (rows) => [stripPlace, table(SESSION_COLUMNS, rows, { caption: "Sessions", file: `${id}-sessions`,
      empty: names.length ? "No telemetry yet: drop a file above, or send it with magcal push." : "No telemetry yet." })]);
    setsTable(sets, (rows) => [table(SET_COLUMNS, rows, { caption: "Parameter sets", file: `${id}-parameter-sets`,
      empty: "No parameter set yet: open a session and start a calibration." })]);
    return sets;
  }
  const [sets] = await Promise.all([tables(), orbits()]);
  live(() => Promise.all([tables(), attention()]), { satellite: id });
  await lives(sets, names, trendPlace);
});
