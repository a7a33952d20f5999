// One magnetometer: how its telemetry is read, and what becomes of it by itself when it arrives.
import { api, confirm, facts, field, form, h, may, notice, option, section, show, start, title } from "./magcal.js";
import { notes } from "./notes.js";
import { choices, optionFields, optionsOf, optionWords } from "./options.js";
import { statusOf } from "./status.js";

const [, , satellite, , id] = location.pathname.split("/").map(decodeURIComponent);
const PATH = `/satellites/${satellite}/magnetometers/${id}`;
const AXES = ["x", "y", "z", "-x", "-y", "-z"];
const NEEDED = ["time", "bx", "by", "bz"];

const listOf = (text) => text.split(",").map((one) => one.trim()).filter(Boolean);
const numberOr = (text, other = null) => (text === "" ? other : Number(text));
const numeric = (text) => (text !== "" && Number.isFinite(Number(text)) ? Number(text) : text);

// The column map as rows of two fields: magcal's name, and the table's own; an empty own name takes a row out.
function columnMap(kept) {
  const rows = h("tbody");
  const add = (name, own) => {
    const isNeeded = NEEDED.includes(name);
    rows.append(h("tr", {}, h("td", {}, isNeeded ? h("code", {}, name) : h("input", { "data-name": true, value: name, "aria-label": "Name in magcal", placeholder: "temperature", maxlength: 200 }),
      isNeeded ? h("input", { type: "hidden", "data-name": true, value: name }) : null),
    h("td", {}, h("input", { "data-own": true, value: own, "aria-label": `Column of ${name || "a further column"}`, placeholder: isNeeded ? name : "its column in your table", maxlength: 200 }))));
  };
  for (const name of NEEDED) add(name, kept[name] ?? "");
  for (const [name, own] of Object.entries(kept)) if (!NEEDED.includes(name)) add(name, own);
  const node = h("fieldset", { class: "wide" }, h("legend", {}, "Column names; empty where the table has magcal's own"),
    h("table", { class: "pairs" }, h("thead", {}, h("tr", {}, h("th", { scope: "col" }, "in magcal"), h("th", { scope: "col" }, "in your tables"))), rows),
    h("button", { type: "button", onclick: () => { add("", ""); rows.lastElementChild.querySelector("input").focus(); } }, "Add a column"));
  const read = () => Object.fromEntries([...rows.rows].map((row) => [row.querySelector("[data-name]").value.trim(), row.querySelector("[data-own]").value.trim()])
    .filter(([name, own]) => name && own));
  return { node, read };
}

function axisMap(kept) {
  const of = kept ?? ["x", "y", "z"];
  return h("fieldset", {}, h("legend", {}, "Which sensor axis the base frame's axes are"),
    ["x", "y", "z"].map((axis, i) => h("label", {}, `base ${axis} = sensor `, h("select", { name: `axis_${axis}` }, AXES.map((one) => option(one, one, one === of[i]))))));
}

function reading(magnetometer) {
  const map = columnMap(magnetometer.columns ?? {});
  return form([
    field("unit", "Unit of its readings", {}, choices.units.map((one) => option(one, one, one === magnetometer.unit))),
    field("nt_per_count", "nT in one count, with the unit counts", { type: "number", min: 0, step: "any", value: magnetometer.nt_per_count }),
    field("noise_nt", "Noise of one reading, nT (1 sigma)", { type: "number", min: 0, step: "any", value: magnetometer.noise_nt }),
    field("integration_s", "Averages a reading over, s: about its time stamp", { type: "number", min: 0, max: 60, step: "any", value: magnetometer.integration_s }),
    field("range_nt", "Range, nT: beyond it a reading is saturated", { type: "number", min: 0, step: "any", value: magnetometer.range_nt }),
    field("time_format", "Form of the times", { list: "time-forms", placeholder: "ISO 8601 with a zone, or seconds since 1970", value: magnetometer.time_format, maxlength: 100 }),
    field("time_epoch", "Seconds since boot count from; year of doy", { placeholder: "2022-02-19T22:00:00Z", value: magnetometer.time_epoch }),
    field("fill_values", "Numbers that stand for no reading", { placeholder: "-9999, 32767", value: magnetometer.fill_values?.join(", ") }),
    field("validity_column", "Column that says which readings are good", { value: magnetometer.validity_column, maxlength: 200 }),
    field("valid_values", "Its values that do", { placeholder: "all but 0, false, invalid", value: magnetometer.valid_values?.join(", ") }),
    axisMap(magnetometer.axis_map), map.node,
    h("datalist", { id: "time-forms" }, Object.entries(choices.time_formats).map(([name, words]) => option(name, words))),
  ], "Change how it is read", async (values) => {
    const axes = ["x", "y", "z"].map((axis) => values[`axis_${axis}`]);
    const columns = map.read();
    await api(PATH, { method: "PATCH", json: {
      unit: values.unit, nt_per_count: numberOr(values.nt_per_count), noise_nt: numberOr(values.noise_nt), integration_s: numberOr(values.integration_s), range_nt: numberOr(values.range_nt),
      time_format: values.time_format.trim() || null, time_epoch: values.time_epoch.trim() || null,
      fill_values: values.fill_values.trim() ? listOf(values.fill_values).map(Number) : null,
      validity_column: values.validity_column.trim() || null, valid_values: values.valid_values.trim() ? listOf(values.valid_values).map(numeric) : null,
      axis_map: axes.join() === "x,y,z" ? null : axes, columns: Object.keys(columns).length ? columns : null } });
    location.reload();
  });
}

function readingFacts(magnetometer) {
  const columns = Object.entries(magnetometer.columns ?? {}).map(([name, own]) => `${name} = ${own}`).join(", ");
  return facts([
    ["unit", magnetometer.unit + (magnetometer.nt_per_count ? ` of ${magnetometer.nt_per_count} nT` : "")],
    ["noise, 1 sigma", magnetometer.noise_nt === null ? "not known" : `${magnetometer.noise_nt} nT`],
    ["averages over", magnetometer.integration_s ? `${magnetometer.integration_s} s` : "not said"], ["range", magnetometer.range_nt === null ? "not known" : `${magnetometer.range_nt} nT`],
    ["columns", columns || "magcal's own names"], ["axes", magnetometer.axis_map?.join(", ") ?? "as sent"],
    ["times", magnetometer.time_format ?? "ISO 8601 with a zone, or seconds since 1970"],
    ["no reading", [magnetometer.fill_values?.join(", "), magnetometer.validity_column && `where ${magnetometer.validity_column} says so`].filter(Boolean).join("; ") || "empty cells"]]);
}

function policySays({ policy }) {
  if (!policy) return h("p", {}, h("strong", {}, "No policy: "), "nothing happens by itself when telemetry arrives.");
  const { calibrate, priority, ...options } = policy;
  return h("p", {}, h("strong", {}, calibrate ? "Each session is calibrated when it arrives" : "The policy is off"),
    `, with ${optionWords(options)}${priority ? `, priority ${priority}` : ""}.`, calibrate ? "" : " Its options serve calibrations from the attention list.");
}

function policyForm({ policy }) {
  const { calibrate = true, priority = 0, ...given } = policy ?? {};
  const node = form([
    h("div", { class: "field" }, h("label", {}, h("input", { type: "checkbox", name: "calibrate", checked: calibrate }), " Calibrate each session when it arrives")),
    field("priority", "Priority, -100 to 100", { type: "number", min: -100, max: 100, step: 1, value: priority }),
    optionFields(given),
  ], policy ? "Change the policy" : "Set the policy", async (values) => {
    await api(PATH, { method: "PATCH", json: { policy: { calibrate: values.calibrate !== undefined, priority: Number(values.priority || 0), ...optionsOf(values, given) } } });
    location.reload();
  });
  if (!policy) return node;
  const remove = async () => {
    if (!await confirm("Remove the policy", h("p", {}, "Telemetry that arrives from now on is kept, and nothing is calibrated by itself."), "Remove", { isGrey: true })) return;
    await api(PATH, { method: "PATCH", json: { policy: null } }).then(() => location.reload(), (problem) => notice(problem.message, "refuse"));
  };
  return [node, h("p", {}, h("button", { type: "button", onclick: remove }, "Remove the policy …"))];
}

start(async () => {
  title(`${satellite} ${id}`);
  const [magnetometer, { items: states }] = await Promise.all([api(PATH), api(`/overview?satellite=${satellite}`)]);
  const own = states.find((row) => row.magnetometer === id);
  show(h("div", { class: "heading" }, h("h1", {}, id), h("p", { class: "muted" }, "magnetometer of ", h("a", { href: `/satellites/${satellite}` }, own?.name ?? satellite)),
    states.length > 1 ? h("p", {}, h("a", { href: `/satellites/${satellite}/magnetometers` }, "Beside the others")) : null),
  own ? statusOf(own, { isAlone: true }) : null,
  section("Policy", policySays(magnetometer), may("operate") ? policyForm(magnetometer) : null),
  section("How its telemetry is read", h("p", { class: "muted" }, "It holds for telemetry that arrives from now on; sessions that are there stay as they were read. To find it from a file, drop one on the satellite's page and look at its first rows."),
    readingFacts(magnetometer), may("operate") ? h("details", {}, h("summary", {}, "Change it"), reading(magnetometer)) : null),
  notes(PATH));
});
