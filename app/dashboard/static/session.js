// One session: what it holds, how good it is, and a calibration of it.
import { ago, agreement, api, causes, facts, fixed, form, grade, h, listed, may, section, short, show, start, tiles, time, title } from "./magcal.js";
import { lines } from "./attention.js";
import { follow } from "./job.js";
import { live } from "./live.js";
import { notes } from "./notes.js";
import { choices, optionFields, optionsOf } from "./options.js";
import { plot } from "./plot.js";
import { previewOf } from "./preview.js";
import { table } from "./table.js";

const id = location.pathname.split("/")[2];

function calibrate() {
  const progress = h("div", { "aria-live": "polite" });
  const preview = previewOf(id);
  const node = form(optionFields({ method: choices.defaults.method }), "Calibrate", async (values) => {
    const body = { kind: "calibration", session_ids: [id], ...optionsOf(values) };
    const job = await api("/jobs", { method: "POST", json: body });
    progress.replaceChildren(follow(job, (ended) => {
      if (ended.state === "succeeded") location.href = `/parameter-sets/${ended.result.parameter_set_id}`;
    }));
  });
  preview.follow(node);
  return [node, preview.node, progress];
}

// What the session says of the set in force, its reasons behind it.
function agrees({ monitoring }) {
  if (!monitoring) return h("p", { class: "muted" }, "Not judged: no set was in force when it arrived.");
  const classes = { disagrees: "refuse", watch: "weak", agrees: "accept" };
  return h("div", { class: `verdict ${classes[monitoring.grade] ?? ""}` }, h("p", {}, agreement(monitoring), " with set ",
    h("a", { href: `/parameter-sets/${monitoring.parameter_set_id}` }, short(monitoring.parameter_set_id)),
    monitoring.residual_rms_nt === null ? "" : `, residual ${fixed(monitoring.residual_rms_nt, 0)} nT, ${fixed(monitoring.residual_ratio, 1)} times that of the set; judged ${ago(monitoring.judged_at)}`),
    h("ul", {}, monitoring.reasons.map((reason) => h("li", {}, reason.replace(/^\w+: /, "")))));
}

// Why the newest calibration of the session failed, where it did: the cause first.
function failure({ items: [job] }) {
  if (job?.state !== "failed" || !job.error) return null;
  return h("section", { id: "cause", class: "verdict refuse" }, h("h2", {}, "Why the last calibration failed"),
    h("p", {}, job.error.detail || job.error.code), causes(job.error.diagnosis),
    h("p", { class: "muted" }, `${ago(job.finished_at ?? job.created_at)}; `, h("a", { href: `/jobs?q=${job.id}` }, `job ${short(job.id)}`)));
}

const flagRows = (quality) => Object.entries(quality.flags ?? {}).map(([name, count]) => [name.replaceAll("_", " "), `${count} samples`]);

start(async () => {
  title(`Session ${short(id)}`);
  const session = await api(`/sessions/${id}`);
  const newest = await api(`/jobs?kind=calibration&limit=1&session=${id}`);
  const { quality } = session;
  const [measured, coverage, keeping] = [h("span", {}, "…"), h("span", {}, "…"), h("div")];
  const setsPlace = section("Parameter sets from this session", h("p", { class: "muted" }, "Loading …"));
  const attentionPlace = h("div");
  const attention = () => api(`/attention?session=${id}&total=true`).then(
    (answer) => attentionPlace.replaceChildren(...(answer.items.length ? lines(answer, attention).filter(Boolean) : [])));
  show(
    h("div", { class: "heading" }, h("h1", {}, `Session ${short(id)}`), h("p", { class: "muted" },
      h("a", { href: `/satellites/${session.satellite}` }, session.satellite), ` · ${session.magnetometer} · ${time(session.data_from)} to ${time(session.data_until)} UTC`)),
    tiles(["samples", fixed(session.samples, 0), `${fixed(session.used_samples, 0)} usable`],
      ["|B| measured, nT", measured], ["coverage of the body sphere", coverage, "by raw direction"],
      ["step", quality.step_s ? `${fixed(quality.step_s, 2)} s` : "–", quality.span_s ? `${fixed(quality.span_s / 3600, 2)} h` : null],
      ["gaps", quality.gaps === undefined ? "–" : String(quality.gaps), quality.gaps && quality.longest_gap_s ? `longest ${fixed(quality.longest_gap_s, 0)} s` : null]),
    session.state === "open" ? h("p", { class: "notice weak" }, "This session is open: further chunks may arrive.") : null,
    attentionPlace, failure(newest), section("Against the set in force", agrees(session)),
    may("operate") && session.samples ? h("section", { id: "calibrate" }, h("h2", {}, "Calibrate"), calibrate()) : null,
    setsPlace,
    section("Readings", plot(`/sessions/${id}/figures/raw`, "|B| as measured and its components", "Crosses are samples with a flag.", 360)),
    section("Coverage", plot(`/sessions/${id}/figures/coverage`, "Where on the body sphere the field was seen", "Two hemispheres of the sensor's axes, equal area; large blank regions leave parameters undetermined.", 400)),
    keeping,
    section("Quality", facts([...flagRows(quality), ["rows without a time", quality.rows_without_time], ["rows out of order", quality.rows_out_of_order],
      ["columns ignored", quality.columns_ignored?.join(", ") || null], ["columns", session.columns.join(", ")]])),
    notes(`/sessions/${id}`),
    section("Bytes", facts([["SHA-256", session.sha256 ? h("code", {}, session.sha256) : null], ["size", `${fixed(session.size_bytes, 0)} bytes`],
      ["received", `${time(session.created_at)} (${ago(session.created_at)})`], ["chunks", String(session.chunks.length)],
      ["download", choices.formats.map((form) => [h("a", { href: `/api/v1/sessions/${id}/samples?format=${form}`, download: true }, form), " "])]])));
  attention();
  api(`/sessions/${id}/summary`).then((summary) => {
    measured.textContent = summary.b_min_nt === null ? "–" : `${fixed(summary.b_min_nt, 0)} … ${fixed(summary.b_max_nt, 0)}`;
    coverage.textContent = summary.sphere_coverage === null ? "–" : `${fixed(100 * summary.sphere_coverage, 0)} %`;
    const count = summary.housekeeping.length;
    if (count) keeping.append(section("Housekeeping", plot(`/sessions/${id}/figures/housekeeping`, "Housekeeping columns", "Each may be a regressor of the bias.", 80 + 130 * count)));
  });
  async function sets() {
    const rows = await listed(`/satellites/${session.satellite}/history?session=${id}`, 200);
    setsPlace.replaceChildren(setsPlace.firstChild, table([
      { name: "parameter set", value: (r) => r.id, show: (r) => h("a", { href: `/parameter-sets/${r.id}` }, short(r.id)) },
      { name: "verdict", value: (r) => r.grade, show: (r) => grade(r.grade) },
      { name: "status", value: (r) => r.status },
      { name: "method", value: (r) => r.method },
      { name: "RMS before, nT", numeric: true, value: (r) => r.rms_before_nt, show: (r) => fixed(r.rms_before_nt) },
      { name: "after", numeric: true, value: (r) => r.rms_nt, show: (r) => fixed(r.rms_nt) },
      { name: "created", value: (r) => r.created_at, show: (r) => time(r.created_at) },
    ], rows, { caption: "Parameter sets from this session", file: `session-${short(id)}-parameter-sets`, empty: "None yet." }));
  }
  await sets();
  live(() => Promise.all([sets(), attention()]), { satellite: session.satellite });
});
