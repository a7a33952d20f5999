// Parameters by name, as tables show them.
import { fixed, h } from "./magcal.js";

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

export const unit = (name) => UNIT[split(name).group] ?? `nT per ${split(name).group.slice(11)}`;
export const digits = (name) => DIGITS[split(name).group] ?? 3;
export const shown = (name, value) => fixed(value, digits(name));

export function parameterTable(record) {
  const rows = record.parameter_names.map((name) => {
    const honest = valueOf(record.standard_errors, name);
    const formal = valueOf(record.formal_standard_errors, name);
    return h("tr", {}, h("th", { scope: "row" }, symbol(name)), h("td", {}, h("code", {}, name)),
      h("td", { class: "n strong" }, shown(name, valueOf(record.parameters, name))), h("td", {}, unit(name)),
      h("td", { class: "n" }, shown(name, honest)), h("td", { class: "n" }, shown(name, formal)),
      h("td", { class: "n" }, honest && formal ? fixed(honest / formal, 1) : "–"));
  });
  const names = ["symbol", "name", "value", "unit", "standard error", "formal", "ratio"];
  return h("div", { class: "scroll", tabindex: "0", role: "region", "aria-label": "Parameters" }, h("table", {},
    h("caption", {}, "The standard error holds under correlated residuals; the formal one is what white noise alone would give."),
    h("thead", {}, h("tr", {}, names.map((name, i) => h("th", { scope: "col", class: i === 2 || i > 3 ? "n" : "" }, name)))),
    h("tbody", {}, rows)));
}

// What changes from one set to another, in numbers and in combined standard errors.
export function differenceTable(before, after, headings = ["in force now", "new", "change"]) {
  const rows = after.parameter_names.map((name) => {
    const [old, made] = [valueOf(before.parameters, name), valueOf(after.parameters, name)];
    const spread = Math.hypot(valueOf(before.standard_errors, name) ?? 0, valueOf(after.standard_errors, name) ?? 0);
    const known = old !== null && made !== null;
    const errors = known && spread ? (made - old) / spread : null;
    return h("tr", { class: errors !== null && Math.abs(errors) > 3 ? "large" : "" }, h("th", { scope: "row" }, symbol(name)),
      h("td", { class: "n" }, shown(name, old)), h("td", { class: "n" }, shown(name, made)),
      h("td", { class: "n strong" }, known ? shown(name, made - old) : "–"), h("td", {}, unit(name)),
      h("td", { class: "n" }, errors === null ? "–" : fixed(errors, 1)));
  });
  const names = ["parameter", ...headings, "unit", "in standard errors"];
  return h("div", { class: "scroll", tabindex: "0", role: "region", "aria-label": "Differences" }, h("table", {},
    h("thead", {}, h("tr", {}, names.map((name, i) => h("th", { scope: "col", class: i && i !== 4 ? "n" : "" }, name)))), h("tbody", {}, rows)));
}

export function statisticsTable(statistics) {
  const names = ["residual, nT", "mean", "standard deviation", "RMS", "largest", "largest, % of |B|"];
  const row = (name, part) => h("tr", {}, h("th", { scope: "row" }, name),
    [["mean_nt", 1], ["std_nt", 1], ["rms_nt", 1], ["max_abs_nt", 1], ["max_percent", 2]].map(([key, places]) =>
      h("td", { class: "n" }, fixed(part[key], places))));
  return h("div", { class: "scroll", tabindex: "0", role: "region", "aria-label": "Residual statistics" }, h("table", {},
    h("thead", {}, h("tr", {}, names.map((name, i) => h("th", { scope: "col", class: i ? "n" : "" }, name)))),
    h("tbody", {}, row("before", statistics.before), row("after", statistics.after))));
}
