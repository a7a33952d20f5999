// What a session will be calibrated with, shown before the button is pressed.
import { api, facts, fixed, h, problemTable, short, time } from "./magcal.js";

const WAIT_MS = 400;
const SOURCES = { request: "as chosen above", policy: "as the magnetometer's policy says", set_in_force: "as the set in force was made", defaults: "the defaults" };

const words = (code) => code.replaceAll("_", " ");
const days = (value) => (value < 0.05 ? "covers the data" : `epoch ${fixed(value, 1)} d from the data`);

function orbitLine(orbit) {
  return h("div", {}, h("strong", {}, orbit.name ?? orbit.format.toUpperCase()), orbit.norad_id ? ` NORAD ${orbit.norad_id}` : "",
    `, ${time(orbit.epoch)}, ${days(orbit.age_days)}, ${orbit.samples ? `${fixed(orbit.samples, 0)} samples` : "the nearest there is, not usable"}`,
    orbit.other_object ? h("strong", { class: "residual refuse" }, ` ✕ another object: ${orbit.other_object}`) : null);
}

function regressorLine({ regressors }) {
  if (!regressors.length) return "none in the telemetry";
  return regressors.map((one) => `${one.name}${one.is_constant ? " (never changes)" : ""}`).join(", ");
}

const fieldLine = (found) => (found.field_model
  ? `${found.field_model}${found.index_needed ? `, driven by the index ${found.index_needed}` : ", no index"}` : "cannot be had");

function positionLine(found) {
  if (found.orbits.length) return found.orbits.map(orbitLine);
  return found.orbit_model ? words(found.orbit_model) : "none";
}

const leftOut = ({ left_out: parts }) => (parts.length ? parts.map((one) => `${words(one.reason)} ${fixed(one.samples, 0)}`).join(", ") : "none");

function view(found) {
  const { problems, warnings } = found;
  const { options } = found;
  return [
    problems.length
      ? h("div", { class: "verdict refuse" }, h("p", {}, h("strong", {}, "✕ This calibration would fail")),
        h("ul", {}, problems.map((one) => h("li", {}, one.detail, " ", h("code", {}, one.code)))))
      : h("p", {}, h("strong", {}, `● ${fixed(found.usable, 0)} of ${fixed(found.samples, 0)} samples will be used`)),
    facts([
      ["orbit", positionLine(found)],
      ["field", fieldLine(found)],
      ["method", `${options.method}, outliers ${options.robust}, clock ${options.time_offset} (${SOURCES[found.options_from]})`],
      ["columns that may be regressors", regressorLine(found)],
      ["samples left out", leftOut(found)],
      ["compared with", found.compared_with ? h("a", { href: `/parameter-sets/${found.compared_with}` }, `set ${short(found.compared_with)}, in force`) : "no set in force is older than these data"],
    ]),
    warnings.length ? h("ul", { class: "small" }, warnings.map((one) => h("li", {}, one.replace(/^\w+: /, "")))) : null,
  ].filter(Boolean);
}

// A panel that says what a calibration by the values of a form will have; it follows the form.
export function previewOf(session) {
  const node = h("div", { class: "preview", role: "region", "aria-live": "polite", "aria-label": "What it will be calibrated with" },
    h("p", { class: "muted" }, "Looking what it will be calibrated with …"));
  let number = 0;
  async function refresh(values) {
    const mine = ++number;
    const asked = new URLSearchParams(Object.entries(values).filter(([, value]) => value));
    try {
      const found = await api(`/sessions/${session}/preview?${asked}`);
      if (mine === number) node.replaceChildren(h("h3", {}, "What it will be calibrated with"), ...view(found));
    } catch (problem) {
      if (mine === number) node.replaceChildren(problemTable(problem));
    }
  }
  function follow(form) {
    let waiting = null;
    const ask = () => refresh(Object.fromEntries(new FormData(form)));
    form.addEventListener("input", () => {
      clearTimeout(waiting);
      waiting = setTimeout(ask, WAIT_MS);
    });
    ask();
  }
  return { node, follow };
}
