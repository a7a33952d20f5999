// The options of a calibration as fields of a form: what is left at its default is not asked for.
import { field, option } from "./magcal.js";

export const choices = JSON.parse(document.getElementById("choices").textContent);

const LABELS = { method: "Method", field: "Field", orbit: "Orbit", time_offset: "Clock offset", robust: "Outliers", noise_model: "Noise model",
  locked_terms: "Errors locked to the orbit", bias_steps: "Steps of the bias", response: "Responses of the sensor" };
const OTHER = ["regressors", "max_orbit_age_days"];
const NAMES = [...Object.keys(choices.options), ...OTHER];

const listOf = (text) => text.split(",").map((one) => one.trim()).filter(Boolean);
const shown = (value) => (Array.isArray(value) ? value.join(", ") : value ?? "");

export function optionFields(given = {}) {
  const select = ([name, values]) => {
    const all = given[name] && !values.includes(given[name]) ? [...values, given[name]] : values;
    return field(name, LABELS[name], {}, [option("", `default: ${choices.defaults[name]}`, !given[name]), ...all.map((one) => option(one, one, given[name] === one))]);
  };
  return [...Object.entries(choices.options).map(select),
    field("regressors", "Regressors", { placeholder: "none; names, or auto", value: shown(given.regressors) || null }),
    field("max_orbit_age_days", "Oldest orbit, days", { type: "number", min: 0, step: "any", placeholder: choices.defaults.max_orbit_age_days, value: given.max_orbit_age_days })];
}

// The options that the fields say, and those of `given` that have no field.
export function optionsOf(values, given = {}) {
  const kept = Object.fromEntries(Object.entries(given).filter(([name, value]) => !NAMES.includes(name) && value !== null));
  for (const name of Object.keys(choices.options)) if (values[name]) kept[name] = values[name];
  const names = listOf(values.regressors);
  if (names.length) kept.regressors = names[0] === "auto" ? "auto" : names;
  if (values.max_orbit_age_days) kept.max_orbit_age_days = Number(values.max_orbit_age_days);
  return kept;
}

// Options in words, those at their defaults left out.
export function optionWords(options) {
  const said = Object.entries(options).filter(([name, value]) => value !== null && value !== undefined && value !== "" && !(Array.isArray(value) && !value.length)
    && String(value) !== String(choices.defaults[name] ?? ""));
  return said.length ? said.map(([name, value]) => `${name.replaceAll("_", " ")} ${typeof value === "object" && !Array.isArray(value) ? JSON.stringify(value) : shown(value)}`).join(", ") : "the defaults";
}
