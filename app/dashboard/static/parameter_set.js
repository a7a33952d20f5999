// One parameter set: the verdict and its reasons first, then numbers, then figures; activate and roll back.
import { api, causes, confirm, contents, facts, fixed, form, field, grade, h, listed, may, notice, nt, option, section, short, show, start, SYMBOLS, tiles, time, title } from "./magcal.js";
import { differenceTable, parameterTable, statisticsTable } from "./parameters.js";
import { follow } from "./job.js";
import { live } from "./live.js";
import { notes } from "./notes.js";
import { plot, whenNear } from "./plot.js";
import { whatIf } from "./refit.js";
import { table } from "./table.js";

const id = location.pathname.split("/")[2];
let again = () => null;
const CONVENTIONS = ["exact", "first-order", "symmetric", "lower-triangular", "a-matrix", "on-board"];

async function activeOf(record) {
  const query = `satellite=${record.satellite}&magnetometer=${record.magnetometer}&status=active&limit=1`;
  return (await api(`/parameter-sets?${query}`)).items[0] ?? null;
}

async function activate(record) {
  const active = await activeOf(record);
  const isRefused = record.verdict.grade === "refuse";
  const reason = h("input", { id: "why", required: true, maxlength: 200 });
  const content = [
    h("p", {}, `${record.satellite}, ${record.magnetometer}: this set (`, grade(record.verdict.grade), ") comes into force for the magnetometer at once. ",
      active ? `The one in force, ${short(active.id)}, is retired; a rollback brings it back.` : "None is in force now."),
    isRefused ? h("p", { class: "notice refuse" }, "Its verdict is refuse. The reason that you give here is kept in the audit trail.") : null,
    isRefused ? h("div", { class: "stack" }, h("label", { for: "why" }, "Why it comes into force all the same"), reason) : null,
    active ? [await rollout(), differenceTable(active, record)] : parameterTable(record)];
  if (!await confirm("Activate this parameter set?", content, isRefused ? "Put the refused set in force" : "Activate", { isGrey: isRefused })) return;
  await change(record, "activate", isRefused ? { force: true, reason: reason.value } : {});
}

// By how much the corrected field changes with this set, today and at the end of its life.
async function rollout() {
  return h("p", {}, (await api(`/parameter-sets/${id}/rollout`)).text);
}

async function rollback(record) {
  const { items } = await api(`/satellites/${record.satellite}/history?magnetometer=${encodeURIComponent(record.magnetometer)}&limit=1000`);
  const before = items.find((row) => row.id === items.find((one) => one.id === id)?.replaced_id);
  const full = before ? await api(`/parameter-sets/${before.id}`) : null;
  const content = [h("p", {}, full ? `Set ${short(full.id)} comes back into force.` : "No set was in force before it: none will be in force then."),
    full ? differenceTable(record, full, ["in force now", "comes back", "change"]) : null];
  if (!await confirm("Roll this parameter set back?", content, "Roll back")) return;
  await change(record, "rollback");
}

async function change(record, verb, json = undefined) {
  try {
    await api(`/parameter-sets/${record.id}/${verb}`, { method: "POST", json });
    notice(verb === "activate" ? "In force now." : "Rolled back.", "accept");
    await draw();
  } catch (problem) {
    notice(problem.message, "refuse");
  }
}

function buttons(record) {
  const made = [];
  if (may("operate") && record.status !== "active") made.push(record.verdict.grade === "refuse"
    ? h("button", { class: "grey", onclick: () => activate(record) }, "Activate although refused …")
    : h("button", { class: "primary", onclick: () => activate(record) }, "Activate …"));
  if (may("operate") && record.status === "active") made.push(h("button", { onclick: () => rollback(record) }, "Roll back …"));
  made.push(h("a", { class: "button", href: `/api/v1/parameter-sets/${record.id}/report` }, "Report"));
  return h("div", { class: "actions" }, made);
}

// Each reason as a sentence with its figure, which limit it passed, and the button that may mend it; codes small behind.
function reasonsOf(record, reasons) {
  const place = h("div", {}, h("ul", {}, reasons.map((reason) => h("li", {}, reason))));
  // A cure that is under way stays: its progress stands in the place of its button.
  place.ask = () => place.querySelector("progress") ? null : api(`/parameter-sets/${record.id}/reasons`).then(({ items }) => place.replaceChildren(...items.map((one) => h("div", { class: "reason" },
    h("strong", {}, one.sentence), ` ${one.figure} `, one.grade && one.grade !== "accept" ? h("span", { class: `badge ${one.grade}` }, one.grade === "refuse" ? "limit of refuse" : "limit of weak") : null, " ",
    h("a", { href: one.page }, h("code", {}, one.code)), cure(one.cure), one.grade === "accept" ? null : h("small", {}, `What to do: ${one.advice}.`)))), () => {});
  place.ask();
  return place;
}

function cure(offered) {
  if (!offered) return null;
  if (offered.method === "GET") return h("span", { class: "actions" }, h("a", { class: "button", href: offered.path }, offered.label));
  if (!may("operate")) return null;
  const place = h("span", { class: "actions" });
  place.append(h("button", { type: "button", onclick: async (event) => {
    event.target.disabled = true;
    try {
      const job = await api(offered.path.replace("/api/v1", ""), { method: "POST", json: offered.body });
      place.replaceChildren(follow(job, (ended) => {
        if (ended.state === "succeeded") location.href = `/parameter-sets/${ended.result.parameter_set_id}`;
      }));
    } catch (problem) {
      event.target.disabled = false;
      notice(problem.message, "refuse");
    }
  } }, offered.label));
  return place;
}

function verdict(record, reasons) {
  const { grade: name } = record.verdict;
  return h("section", { class: `verdict ${name}`, "aria-label": "Verdict" }, h("div", { class: "word" }, `${SYMBOLS[name]} ${name}`),
    reasons, causes(record.diagnosis),
    record.advice?.length ? [h("h2", {}, "Advice"), h("ul", {}, record.advice.map((one) => h("li", {}, one)))] : null,
    record.warnings.length ? [h("h2", {}, "Warnings"), h("ul", {}, record.warnings.map((warning) => h("li", {}, warning)))] : null);
}

function candidates(record) {
  if (!record.candidates.length) return null;
  const rows = record.candidates.map((one, i) => ({ number: i + 1, ...one }));
  return section("Candidate solutions of the closed form", table([
    { name: "no.", numeric: true, value: (r) => r.number },
    { name: "cost, nT²", numeric: true, value: (r) => r.cost, show: (r) => r.cost?.toPrecision(6) },
    { name: "stationarity", numeric: true, value: (r) => r.stationarity, show: (r) => r.stationarity?.toPrecision(2) },
    { name: "selected", value: (r) => (r.selected ? "yes" : "no") },
    { name: "bias, nT", value: (r) => r.parameters?.bias_nt.join(" ") ?? r.undefined ?? "undefined",
      show: (r) => r.parameters ? r.parameters.bias_nt.map((value) => fixed(value, 1)).join("; ") : r.undefined ?? "undefined" },
  ], rows, { caption: "Candidates", file: `candidates-${record.id}` }));
}

function ablation(record) {
  if (!record.ablation?.length) return null;
  return section("Choice of the model", table([
    { name: "model", value: (r) => r.name ?? ["9 parameters", ...(r.regressors ?? [])].join(" + "), heads: true },
    { name: "parameters", numeric: true, value: (r) => r.parameters },
    { name: "RMS in the fit, nT", numeric: true, value: (r) => r.rms_nt, show: (r) => fixed(r.rms_nt) },
    { name: "cross-validated, nT", numeric: true, value: (r) => r.cross_validated_rms_nt, show: (r) => fixed(r.cross_validated_rms_nt) },
    { name: "taken", value: (r) => (r.selected ? "yes" : "") },
  ], record.ablation, { caption: "Models that were tried", file: `models-${record.id}` }),
  plot(`/parameter-sets/${id}/figures/ablation`, "Models that were tried", "Taken for the cross-validated residual, never for the residual in the fit.", 260));
}

function exporter(record) {
  return form([field("convention", "Convention", {}, CONVENTIONS.map((name) => option(name))),
    field("format", "Format", {}, ["json", "yaml", "csv", "c"].map((name) => option(name)))], "Save", async (values) => {
    const answer = await fetch(`/api/v1/parameter-sets/${record.id}/export?${new URLSearchParams(values)}`);
    if (!answer.ok) throw new Error((await answer.json()).detail);
    const link = h("a", { href: URL.createObjectURL(await answer.blob()), download: `${record.satellite}-${record.magnetometer}-${values.convention}.${values.format === "c" ? "h" : values.format}` });
    link.click();
  });
}

function comparer(record, others) {
  const rows = others.filter((row) => row.id !== record.id && row.magnetometer === record.magnetometer);
  if (!rows.length) return h("p", { class: "muted" }, "There is no other set of this magnetometer.");
  return form([field("second", "With", {}, rows.map((row) => option(row.id, `${short(row.id)} · ${time(row.data_from)} · ${row.method} · ${row.grade}${row.status === "active" ? " · active" : ""}`)))],
    "Compare", async ({ second }) => { location.href = `/compare?first=${record.id}&second=${second}`; });
}

// Attitude by magnetometer, simulated where it is asked for: it takes a second or two.
function pointing() {
  const place = h("div");
  const names = { ideal: "perfect magnetometer", raw: "this magnetometer, raw", calibrated: "corrected with this set", active: "corrected with the set in force" };
  place.append(form([], "Simulate", async () => {
    const impact = await api(`/parameter-sets/${id}/pointing`);
    place.replaceChildren(table([
      { name: "magnetometer", value: (key) => names[key], heads: true },
      ...impact.orbits.flatMap((orbit) => {
        const where = `${fixed(orbit.altitude_km, 0)} km, ${fixed(orbit.inclination_deg, 1)}°`;
        return [{ name: `${where}: error, deg`, numeric: true, value: (key) => orbit[key].max_error_deg, show: (key) => fixed(orbit[key].max_error_deg, 2) },
          { name: "rate error, deg/s", numeric: true, value: (key) => orbit[key].max_rate_error_deg_s, show: (key) => fixed(orbit[key].max_rate_error_deg_s, 4) }];
      })], Object.keys(names).filter((key) => impact.orbits[0][key]), { caption: "Pointing impact", file: `pointing-${id}`,
      note: `Largest errors of the last two orbits, with magnetometer, gyros and wheels alone, in ${impact.field_model}; the worst of 16 sensors drawn from the covariance.` }));
  }));
  return [h("p", { class: "muted" }, "How well attitude by magnetometer would point on this satellite's orbit."), place];
}

function provenance(record) {
  const { provenance: from } = record;
  const text = (value) => {
    if (value === null || value === undefined || value === "") return "–";
    if (Array.isArray(value)) return value.map(text).join(", ") || "none";
    if (typeof value === "object") return Object.entries(value).map(([name, one]) => `${name.replaceAll("_", " ")} ${text(one)}`).join(", ");
    return value === true ? "yes" : value === false ? "no" : String(value);
  };
  return facts([
    ["parameter set", h("code", {}, record.id)], ["created", time(record.created_at)], ["job", h("code", {}, record.job_id)],
    ["sessions", record.session_ids.map((one) => [h("a", { href: `/sessions/${one}` }, short(one)), " "])],
    ...(from.inputs ?? []).map((input, i) => [`input ${i + 1}`, h("code", {}, input.sha256 ?? text(input))]),
    ...(from.orbits ?? []).map((orbit, i) => [`orbit ${i + 1}`, Object.entries(orbit).map(([name, value]) => `${name.replaceAll("_", " ")} ${typeof value === "number" ? fixed(value, Number.isInteger(value) ? 0 : 2) : text(value)}`).join(", ")]),
    ...Object.entries(from.options ?? {}).map(([name, value]) => [name.replaceAll("_", " "), text(value)]),
    ["software", from.software ? software(from.software) : null]]);
}

const software = ({ name, version, ...parts }) => [`${name} ${version}`, ...Object.entries(parts).map((part) => part.join(" "))].join(", ");

function steps(record) {
  const { items, is_fitted: isFitted } = record.bias_steps;
  if (!items.length) return h("p", { class: "muted" }, "No step of the bias shows.");
  return h("ul", {}, items.map((step) => h("li", {}, step.text, isFitted ? "; the set's bias is that after the last step" : "; named, not removed: calibrate with bias_steps fit")));
}

function windows(record) {
  const { hours, items, trend } = record.windows;
  return [h("p", {}, `Calibrated one by one in windows of ${fixed(hours, 1)} h; at the end of the data their trend has the bias at `,
    trend.parameters.bias_nt.map((value, i) => `${fixed(value, 0)} ± ${fixed(trend.standard_errors.bias_nt[i], 0)}`).join(", "), " nT."),
  table([
    { name: "from", value: (r) => r.from, show: (r) => time(r.from) },
    { name: "until", value: (r) => r.until, show: (r) => time(r.until) },
    { name: "verdict", value: (r) => r.verdict?.grade ?? r.error, show: (r) => r.verdict ? grade(r.verdict.grade) : r.error },
    { name: "bias, nT", value: (r) => r.parameters?.bias_nt.join(" ") ?? "", show: (r) => r.parameters ? r.parameters.bias_nt.map((value) => fixed(value, 1)).join("; ") : "–" },
  ], items, { caption: "Windows", file: `windows-${record.id}` })];
}

function first_order(record) {
  return record.first_order ? h("p", { class: "muted" }, "First-order parameters of the DEKART paper: scale ",
    record.first_order.scale.map((value) => fixed(value, 6)).join(", "), "; angles ",
    record.first_order.nonorthogonality_deg.map((value) => fixed(value, 4)).join(", "), " deg. They belong to the paper's first-order matrix.") : null;
}

async function draw() {
  const record = await api(`/parameter-sets/${id}`);
  const { statistics, observability } = record;
  const figure = (name, ...rest) => plot(`/parameter-sets/${id}/figures/${name}`, ...rest);
  const others = h("div", {}, h("p", { class: "muted" }, "Loading …"));
  const reasons = reasonsOf(record, record.verdict.reasons);
  const [status, acts] = [h("span"), h("div")];
  const stand = (now) => {
    status.replaceChildren(h("span", { class: `badge status-${now.status}` }, now.status));
    acts.replaceChildren(buttons(now));
  };
  stand(record);
  title(`${record.satellite} ${short(id)}`);
  show(
    h("div", { class: "heading" }, h("h1", {}, `Parameter set ${short(id)}`, " ", status),
      h("p", { class: "muted" }, h("a", { href: `/satellites/${record.satellite}` }, record.satellite), ` · ${record.magnetometer} · ${record.method} · ${time(record.data_from)} to ${time(record.data_until)} UTC`), acts),
    verdict(record, reasons),
    tiles(["residual RMS", `${fixed(statistics.before.rms_nt, 0)} → ${nt(statistics.after.rms_nt)}`, "before → after"],
      ["cross-validated", nt(statistics.cross_validated_rms_nt), "six blocks of time, each left out in turn"],
      ["samples", fixed(statistics.samples, 0), `${fixed(statistics.rejected, 0)} left out`],
      ["observability index", fixed(observability.index, 1), "over 10 is good, under 3 is not observable"],
      ["coverage", `${fixed(100 * observability.sphere_coverage, 0)} %`, observability.weak_directions.length ? `weak: ${observability.weak_directions.join(", ")}` : "of the body sphere"]),
    section("Before and after", figure("before-after", "|B| against the model", "Above the reading as it came, below after the correction; dots are the reference field.", 520)),
    section("Parameters", parameterTable(record), first_order(record)),
    section("Residuals", statisticsTable(statistics),
      figure("residual-time", "Residual against time", "Crosses are samples that the fit left out."),
      h("div", { class: "pair" }, figure("histogram", "Distribution", "Dashed: the normal distribution of the same mean and spread."),
        figure("autocorrelation", "Autocorrelation", "Outside the grey band residuals are not white, and formal errors are too small.")),
      h("div", { class: "pair" }, figure("sphere", "On the body sphere", "Residual by the direction of the field in the sensor's frame, equal area.", 400),
        figure("map", "Over the Earth", "Residual by geocentric latitude and longitude of the satellite; thin lines: |B| of IGRF at its height, nT.", 420))),
    record.bias_steps?.state === "searched" ? section("The bias over its data", steps(record),
      figure("bias-path", "Path of the bias", "Line and 95 % band: the bias over time; dashed, with its own bar: the one value that the set has for all of it; hatched: steps.", 560)) : null,
    record.windows ? section("Windows", windows(record)) : null,
    section("Correlation", figure("correlation", "Correlation of the parameters", "From the honest covariance.", 410)),
    ablation(record),
    section("What if", whatIf(record)),
    section("Pointing impact", pointing()),
    candidates(record),
    section("Compare", others),
    section("Export for flight software", exporter(record)),
    notes(`/parameter-sets/${id}`),
    section("Provenance", provenance(record)));
  document.querySelector("#main > .heading").after(contents());
  const compare = async () => {
    const rows = await listed(`/satellites/${record.satellite}/history?magnetometer=${encodeURIComponent(record.magnetometer)}`, 1000);
    others.replaceChildren(comparer(record, rows));
  };
  let isNear = false;
  whenNear(others, () => { isNear = true; return compare(); });
  // The numbers of a set never change; whether it is in force, what mends it and what it may be compared with do.
  again = async () => {
    stand(await api(`/parameter-sets/${id}`));
    await reasons.ask();
    if (isNear && !others.contains(document.activeElement)) await compare();
  };
  return record;
}

start(async () => {
  const { satellite } = await draw();
  live(() => again(), { satellite });
});
