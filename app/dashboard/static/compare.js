// Two parameter sets side by side.
import { api, grade, h, nt, section, short, show, start, time, title } from "./magcal.js";
import { live } from "./live.js";
import { differenceTable } from "./parameters.js";
import { plot } from "./plot.js";

const WORDS = { same: ["accept", "● Agree"], differs: ["refuse", "✕ Differ"], cannot_tell: ["weak", "◆ Cannot tell"] };
const query = new URLSearchParams(location.search);

function head(record, heading) {
  return h("div", {}, h("h2", {}, heading, " ", h("a", { href: `/parameter-sets/${record.id}` }, short(record.id))),
    h("p", {}, grade(record.verdict.grade), ` ${record.status} · ${record.satellite} ${record.magnetometer}`),
    h("p", { class: "muted" }, `${record.method} · ${time(record.data_from)} · residual ${nt(record.statistics.after.rms_nt)}, cross-validated ${nt(record.statistics.cross_validated_rms_nt)}`));
}

// The word first; why, and what differs most, behind it.
function verdict({ word, text }) {
  const [grade, said] = WORDS[word];
  return h("section", { class: `verdict ${grade}`, "aria-label": "Comparison" }, h("div", { class: "word" }, said),
    h("p", {}, text.replace(/^(Same|Differs|Cannot tell): /, "")));
}

start(async () => {
  title("Compare");
  if (!query.get("first") || !query.get("second")) {
    show(h("h1", {}, "Compare parameter sets"), h("p", {}, "Choose the two on the page of a parameter set."));
    return;
  }
  const ask = () => Promise.all([...[query.get("first"), query.get("second")].map((id) => api(`/parameter-sets/${id}`)),
    api(`/parameter-sets/${query.get("second")}/comparison?other=${query.get("first")}`)]);
  const [first, second, compared] = await ask();
  const address = `/figures/compare?first=${first.id}&second=${second.id}`;
  const [word, heads] = [h("div", {}, verdict(compared)), h("div", { class: "pair" }, head(first, "First:"), head(second, "Second:"))];
  show(h("h1", {}, "Compare parameter sets"), word, heads,
    section("Parameters", differenceTable(first, second, ["first", "second", "second − first"])),
    plot(address, "Differences in combined standard errors", "Beyond the dotted lines, at three, the two do not agree within their honest errors.", 300));
  // The numbers of a set never change; which one is in force does.
  live(async () => {
    const [one, other, now] = await ask();
    word.replaceChildren(verdict(now));
    heads.replaceChildren(head(one, "First:"), head(other, "Second:"));
  }, { types: ["parameter_set.activated"], satellite: first.satellite });
});
