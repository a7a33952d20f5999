// What the fit would say without a span of time, or with other regressors: a refit from its stored moments.
import { api, field, fixed, form, h, nt, option, tiles, time } from "./magcal.js";
import { differenceTable, digits, number, valueOf } from "./parameters.js";

function queryOf(values) {
  const query = new URLSearchParams();
  if (values.from || values.until) query.append("without", `${values.from.trim()}Z/${values.until.trim()}Z`);
  const names = values.regressors.trim();
  if (names) query.append("regressors", names === "none" ? "" : names);
  if (values.time_offset) query.append("time_offset", values.time_offset);
  if (values.bootstrap) query.append("bootstrap", values.bootstrap);
  return query;
}

function shown(record, found) {
  const { bootstrap, time_offset: clock } = found;
  const names = found.changes.map((change) => change.parameter);
  const model = found.ablation.find((one) => one.selected)?.regressors ?? [];
  const errors = { "standard error": found.standard_errors, ...(bootstrap ? { "bootstrap error": bootstrap.standard_errors } : {}) };
  const columns = Object.entries(errors).map(([heading, of]) => number(heading, (name) => valueOf(of, name), digits));
  return [
    ...found.warnings.map((text) => h("p", { class: "muted" }, text)),
    tiles(["residual RMS", nt(found.rms_nt), `${nt(record.statistics.after.rms_nt)} in the set`],
      ["cross-validated", nt(found.cross_validated_rms_nt), `${nt(record.statistics.cross_validated_rms_nt)} in the set`],
      ["samples", fixed(found.samples, 0), `${fixed(100 * found.left_out_share, 1)} % left out`],
      ["regressors", model.join(", ") || "none", null],
      clock ? ["clock offset", `${fixed(clock.offset_s, 2)} s`, `± ${fixed(clock.standard_error_s, 2)} s`] : null),
    differenceTable(record, { ...found, id: "refit", parameter_names: names }, ["in the set", "refit", "change"], columns)];
}

export function whatIf(record) {
  const place = h("div", { "aria-live": "polite" });
  return [
    h("p", { class: "muted" }, "One step from this fit, from what it has kept of its data: the weights of the samples stay, nothing is stored. Calibrate the session anew for a set to put in force."),
    form([
      field("from", "Leave out from, UTC", { placeholder: time(record.data_from) }),
      field("until", "until, UTC", { placeholder: time(record.data_until) }),
      field("regressors", "Regressors", { placeholder: "as in the set; names, none, or auto" }),
      field("time_offset", "Clock offset", {}, [option("", "as in the set"), option("true", "unknown"), option("false", "held")]),
      field("bootstrap", "Bootstrap replicates", { type: "number", min: 0, max: 10000, placeholder: "0" }),
    ], "Refit", async (values) => {
      place.replaceChildren();
      place.replaceChildren(...shown(record, await api(`/parameter-sets/${record.id}/refit?${queryOf(values)}`)));
    }), place];
}
