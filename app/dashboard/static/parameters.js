// Parameters by name, as tables show them.
import { fixed, h } from "./magcal.js";
import { table } from "./table.js";

const LETTER = { bias_nt: "b", scale: "k", nonorthogonality_deg: "ε" };
const UNIT = { bias_nt: "nT", scale: "", nonorthogonality_deg: "deg", time_offset_s: "s" };
const DIGITS = { bias_nt: 1, scale: 6, nonorthogonality_deg: 4, time_offset_s: 3 };

export function split(name) {
  const [group, index] = name.replace("]", "").split("[");
  return { group, index: index === undefined ? null : Number(index) };
}

export function valueOf(parameters, name) {
  const { group, index } = split(name);
  if (group.startsWith("regressors.")) return parameters.regressors?.[group.slice(11)]?.[index] ?? null;
  return index === null ? parameters[group] : parameters[group]?.[index] ?? null;
}

export function symbol(name) {
  const { group, index } = split(name);
  if (group === "time_offset_s") return "Δt";
  return group.startsWith("regressors.") ? `${group.slice(11)} ${index + 1}` : `${LETTER[group]}${index + 1}`;
}

const isOfScale = (group) => group.endsWith("*h");
const per = (regressor) => (isOfScale(regressor) ? `per ${regressor.slice(0, -2)}` : `nT per ${regressor}`);
export const unit = (name) => UNIT[split(name).group] ?? per(split(name).group.slice(11));
export const digits = (name) => DIGITS[split(name).group] ?? (isOfScale(split(name).group) ? 7 : 3);

const named = (name) => ({ name, value: symbol, heads: true });
export const number = (name, value, places, more = {}) => ({ name, numeric: true, value, show: (row) => fixed(value(row), places(row)), ...more });

export function parameterTable(record) {
  const of = (parameters) => (name) => valueOf(parameters, name);
  const ratio = (name) => of(record.standard_errors)(name) / of(record.formal_standard_errors)(name);
  return table([
    named("symbol"),
    { name: "name", value: (name) => name, show: (name) => h("code", {}, name) },
    number("value", of(record.parameters), digits, { strong: true }),
    { name: "unit", value: unit },
    number("standard error", of(record.standard_errors), digits),
    number("formal", of(record.formal_standard_errors), digits),
    number("ratio", ratio, () => 1),
  ], record.parameter_names, { caption: "Parameters", file: `parameters-${record.id}`,
    note: "The standard error holds under correlated residuals; the formal one is what white noise alone would give." });
}

// What changes from one set to another, in numbers and in combined standard errors.
export function differenceTable(before, after, headings = ["in force now", "new", "change"], more = []) {
  const [old, made] = [before, after].map((record) => (name) => valueOf(record.parameters, name));
  const change = (name) => (old(name) === null || made(name) === null ? null : made(name) - old(name));
  const spread = (name) => Math.hypot(valueOf(before.standard_errors, name) ?? 0, valueOf(after.standard_errors, name) ?? 0);
  const errors = (name) => (change(name) === null || !spread(name) ? null : change(name) / spread(name));
  const names = [...after.parameter_names, ...before.parameter_names.filter((name) => !after.parameter_names.includes(name))];
  return table([
    named("parameter"),
    number(headings[0], old, digits),
    number(headings[1], made, digits),
    number(headings[2], change, digits, { strong: true }),
    { name: "unit", value: unit },
    number("in standard errors", errors, () => 1),
    ...more,
  ], names, { caption: "Differences", file: `differences-${before.id}-${after.id}`, look: (name) => (Math.abs(errors(name)) > 3 ? "large" : "") });
}

export function statisticsTable(statistics) {
  const part = (name, key, places) => number(name, (row) => statistics[row][key], () => places);
  return table([
    { name: "residual, nT", value: (row) => row, heads: true },
    part("mean", "mean_nt", 1), part("standard deviation", "std_nt", 1), part("RMS", "rms_nt", 1),
    part("largest", "max_abs_nt", 1), part("largest, % of |B|", "max_percent", 2),
  ], ["before", "after"], { caption: "Residual statistics", file: "residual-statistics" });
}
