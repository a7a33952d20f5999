// The magnetometers of a satellite beside each other, and two of them compared in flight, each corrected with its set.
import { age, api, field, fixed, form, grade, h, listed, nt, option, section, show, start, tiles, time, title } from "./magcal.js";
import { digits, symbol, unit, valueOf } from "./parameters.js";
import { optionWords } from "./options.js";
import { magnetometerPage } from "./status.js";
import { table } from "./table.js";

const satellite = decodeURIComponent(location.pathname.split("/")[2]);
const MOST_SESSIONS = 200;

function policyWords(policy) {
  if (!policy?.calibrate) return "none";
  const { calibrate: _on, priority: _when, ...options } = policy;
  return `calibrates with ${optionWords(options)}`;
}

function besides(magnetometers, states, records) {
  const stateOf = (one) => states.find((row) => row.magnetometer === one.id);
  const names = [...new Set(records.filter(Boolean).flatMap((record) => record.parameter_names))];
  const value = (record, name) => (record && valueOf(record.parameters, name) !== null
    ? `${fixed(valueOf(record.parameters, name), digits(name))} ± ${fixed(valueOf(record.standard_errors, name), digits(name))}` : "–");
  const rows = [
    ["set in force", (one) => { const { active } = stateOf(one); return active ? h("a", { href: `/parameter-sets/${active.id}` }, grade(active.grade)) : "none"; }],
    ["of data until", (one) => time(stateOf(one).active?.data_until)],
    ["residual", (one) => nt(stateOf(one).active?.rms_nt)],
    ["newest session", (one) => { const { last_session: last } = stateOf(one); return last ? h("a", { href: `/sessions/${last.id}` }, `${age(last.data_until)} old`) : "none"; }],
    ["policy", (one) => policyWords(one.policy)],
    ["unit, noise", (one) => `${one.unit}, ${nt(one.noise_nt, 0)}`],
    ["axes", (one) => one.axis_map?.join(", ") ?? "as sent"],
    ...names.map((name) => [`${symbol(name)}${unit(name) ? `, ${unit(name)}` : ""}`, (_one, i) => value(records[i], name)])];
  return h("div", { class: "scroll", tabindex: "0", role: "region", "aria-label": "Magnetometers beside each other" }, h("table", { class: "beside" },
    h("thead", {}, h("tr", {}, h("th", { scope: "col" }, "magnetometer"), magnetometers.map((one) => h("th", { scope: "col" }, h("a", { href: magnetometerPage(satellite, one.id) }, one.id))))),
    h("tbody", {}, rows.map(([name, of]) => h("tr", {}, h("th", { scope: "row" }, name), magnetometers.map((one, i) => h("td", {}, of(one, i))))))));
}

const overlaps = (a, b) => a.data_from && b.data_from && a.data_from <= b.data_until && b.data_from <= a.data_until;
const clock = (text) => time(text).slice(0, 16);

function shown(found, [first, second]) {
  const turn = Math.hypot(...found.rotation_vector_deg);
  const rows = ["x", "y", "z"].map((axis, i) => ({ axis, turn: found.rotation_vector_deg[i], turnError: found.rotation_errors_deg[i], offset: found.offset_nt[i], offsetError: found.offset_errors_nt[i],
    gain: found.gain[i][i], gainError: found.gain_errors[i][i] }));
  const column = (name, of, places) => ({ name, numeric: true, value: of, show: (row) => fixed(of(row), places) });
  return [
    found.findings.length ? h("ul", { "aria-label": "Findings" }, found.findings.map((one) => h("li", {}, one.replace(/^\w+: /, "")))) : h("p", { class: "accept" }, h("strong", { class: "badge" }, "● Nothing found"), " the two agree within their errors"),
    tiles(["pairs of readings", fixed(found.pairs, 0)], ["difference before", nt(found.rms_before_nt), "root mean square"], ["after", nt(found.rms_after_nt), "turned, scaled and shifted onto each other"],
      ["turn between them", `${fixed(turn, 3)} deg`, `${first.magnetometer} from ${second.magnetometer}`]),
    table([{ name: "axis", value: (row) => row.axis, heads: true }, column("turn, deg", (row) => row.turn, 4), column("± ", (row) => row.turnError, 4), column("offset, nT", (row) => row.offset, 1),
      column("± nT", (row) => row.offsetError, 1), column("gain", (row) => row.gain, 6), column("± gain", (row) => row.gainError, 6)], rows, { caption: "Differences by axis", file: `${satellite}-magnetometers` })];
}

function comparison(magnetometers, states, sessions) {
  const [left, right] = magnetometers.slice(0, 2).map((one) => one.id);
  const place = h("div", { "aria-live": "polite" });
  const pick = (name, text, chosen) => field(name, text, {}, magnetometers.map((one) => option(one.id, one.id, one.id === chosen)));
  const pairs = h("select", { name: "pair", id: "pair", required: true });
  const setOf = (id) => { const row = states.find((one) => one.magnetometer === id); return row.active ? null : row.newest?.id ?? null; };
  let found = [];
  const node = form([pick("first", "First", left), pick("second", "Second", right), h("div", { class: "field" }, h("label", { for: "pair" }, "Sessions of the same time"), pairs),
    field("distance_m", "Distance between them, m", { type: "number", min: 0, step: "any", placeholder: "not known" })], "Compare", async (values) => {
    const [a, b] = found[Number(values.pair)] ?? [];
    if (!a) throw new Error("the two have no sessions of the same time");
    const query = new URLSearchParams({ other: b.id });
    if (setOf(a.magnetometer)) query.set("parameter_set", setOf(a.magnetometer));
    if (setOf(b.magnetometer)) query.set("other_parameter_set", setOf(b.magnetometer));
    if (values.distance_m) query.set("distance_m", values.distance_m);
    place.replaceChildren(h("p", { class: "muted" }, "Comparing …"));
    try {
      place.replaceChildren(...shown(await api(`/sessions/${a.id}/comparison?${query}`), [a, b]));
    } catch (problem) {
      place.replaceChildren();
      throw problem;
    }
  });
  function offer() {
    const of = (name) => sessions.filter((one) => one.magnetometer === node.elements[name].value);
    found = of("first").flatMap((a) => of("second").filter((b) => a.magnetometer !== b.magnetometer && overlaps(a, b)).map((b) => [a, b])).slice(0, MOST_SESSIONS);
    pairs.replaceChildren(...(found.length ? found.map(([a, b], i) => option(String(i), a.data_from === b.data_from ? clock(a.data_from) : `${clock(a.data_from)} and ${clock(b.data_from)}`)) : [option("", "none of the same time")]));
  }
  for (const name of ["first", "second"]) node.elements[name].addEventListener("change", offer);
  offer();
  return [node, place];
}

start(async () => {
  title(`Magnetometers of ${satellite}`);
  const [found, { items: states }] = await Promise.all([api(`/satellites/${satellite}`), api(`/overview?satellite=${satellite}`)]);
  const { magnetometers } = found;
  const records = await Promise.all(magnetometers.map((one) => {
    const active = states.find((row) => row.magnetometer === one.id)?.active;
    return active ? api(`/parameter-sets/${active.id}`) : null;
  }));
  const sessions = magnetometers.length > 1 ? await listed(`/sessions?satellite=${satellite}`, MOST_SESSIONS * magnetometers.length) : [];
  show(h("div", { class: "heading" }, h("h1", {}, "Magnetometers"), h("p", { class: "muted" }, "of ", h("a", { href: `/satellites/${satellite}` }, found.name ?? satellite))),
    magnetometers.length ? besides(magnetometers, states, records) : h("p", {}, "The satellite has none yet."),
    magnetometers.length > 1 ? section("Two of them in flight", h("p", { class: "muted" }, "Each is corrected with its set in force, or with its newest where none is; what is left between them is a turn, an offset and a gain."), comparison(magnetometers, states, sessions)) : null);
});
