// What needs attention: one line a magnetometer and cause, with the button that mends it.
import { ago, api, h, may, notice, short, time } from "./magcal.js";

export const SIGNS = { act: "✕", watch: "◆", good: "●" };

async function press(entry, button, again) {
  button.disabled = true;
  try {
    const made = await api(entry.action.path.replace("/api/v1", ""), { method: "POST", json: entry.action.body });
    const isJob = /\/jobs(\/[^/]+\/retry)?$/.test(entry.action.path);
    notice(isJob ? `Queued as job ${short(made.id)}.` : `${entry.action.label}: done.`, "accept");
  } catch (problem) {
    notice(problem.message, "refuse");
  }
  await again();
  button.disabled = false;
}

// A question in a dialog: what is being done about it, and until when it may stay so.
function acknowledge(entry, again) {
  const note = h("textarea", { id: "ack-note", rows: 3, required: true, maxlength: 2000 });
  const until = h("select", { id: "ack-until" }, [["", "until it changes"], ["8", "8 hours"], ["24", "1 day"], ["168", "7 days"]].map(
    ([value, word]) => h("option", { value }, word)));
  const dialog = h("dialog", { "aria-labelledby": "ack-title" }, h("form", { method: "dialog" },
    h("h2", { id: "ack-title" }, "Acknowledge"), h("p", {}, entry.text),
    h("div", { class: "stack" }, h("label", { for: "ack-note" }, "Note: what is being done about it"), note,
      h("label", { for: "ack-until" }, "It stays acknowledged"), until),
    h("div", { class: "actions" }, h("button", { value: "yes", class: "primary" }, "Acknowledge"),
      h("button", { value: "no", formnovalidate: true }, "Leave it"))));
  dialog.addEventListener("close", async () => {
    dialog.remove();
    if (dialog.returnValue !== "yes") return;
    const json = { note: note.value };
    if (until.value) json.until = new Date(Date.now() + Number(until.value) * 3600e3).toISOString();
    await api(`/attention/${entry.id}/acknowledge`, { method: "POST", json }).catch((problem) => notice(problem.message, "refuse"));
    await again();
  });
  document.body.append(dialog);
  dialog.showModal();
}

function button(entry, again) {
  const { action } = entry;
  if (!action) return null;
  if (action.method === "GET") return h("a", { class: `button${entry.severity === "act" ? " primary" : ""}`, href: action.path }, action.label);
  if (!may("operate")) return null;
  const made = h("button", { type: "button", class: entry.severity === "act" ? "primary" : "", onclick: () => press(entry, made, again) }, action.label);
  return made;
}

const links = ({ links: of }) => [
  of.session_id ? h("a", { href: `/sessions/${of.session_id}` }, `session ${short(of.session_id)}`) : null,
  of.parameter_set_id ? h("a", { href: `/parameter-sets/${of.parameter_set_id}` }, `set ${short(of.parameter_set_id)}`) : null,
  of.job_id ? h("a", { href: `/jobs?q=${of.job_id}` }, `job ${short(of.job_id)}`) : null,
].filter(Boolean);

export function line(entry, again, { withPlace = true, names = new Map() } = {}) {
  const seen = entry.acknowledged;
  return h("li", { class: `entry ${entry.severity}${seen ? " seen" : ""}`, "data-code": entry.code },
    h("span", { class: "sign", "aria-hidden": "true" }, SIGNS[entry.severity]),
    h("div", { class: "what" },
      h("p", { class: "place" }, withPlace ? [h("a", { href: `/satellites/${entry.satellite_id}` }, h("strong", {}, names.get(entry.satellite_id) ?? entry.satellite_id)), ` ${entry.magnetometer_id} `] : null,
        h("span", { class: "muted", title: time(entry.since) }, `since ${ago(entry.since)}`)),
      h("p", {}, h("span", { class: "hidden-word" }, entry.severity === "act" ? "To do: " : "To watch: "), entry.text),
      h("p", { class: "muted small" }, links(entry).flatMap((one, i) => (i ? [" · ", one] : [one])), " ", h("code", {}, entry.code),
        seen ? [h("br"), `Acknowledged ${ago(seen.at)} by ${seen.author ?? seen.by ?? "–"}${seen.until ? ` until ${time(seen.until)}` : ""}: ${seen.note ?? ""}`] : null)),
    h("div", { class: "actions" }, button(entry, again),
      !seen && may("operate") ? h("button", { type: "button", class: "quiet", "aria-label": `Acknowledge ${entry.satellite_id} ${entry.magnetometer_id} ${entry.code}`,
        onclick: () => acknowledge(entry, again) }, "Acknowledge …") : null));
}

// Lines of a list of entries: those to deal with, then, folded, those that somebody has acknowledged.
export function lines(answer, again, options = {}) {
  const open = answer.items.filter((entry) => !entry.acknowledged);
  const seen = answer.items.filter((entry) => entry.acknowledged);
  const left = (answer.total ?? answer.items.length) - answer.items.length;
  return [
    open.length ? h("ul", { class: "attention", "aria-label": "Needs attention" }, open.map((entry) => line(entry, again, options)))
      : h("p", { class: "notice accept" }, h("strong", {}, "● Nothing needs attention.")),
    left > 0 ? h("p", { class: "muted" }, `${left} more are not shown.`) : null,
    seen.length ? h("details", {}, h("summary", {}, `${seen.length} acknowledged`), h("ul", { class: "attention" }, seen.map((entry) => line(entry, again, options)))) : null,
  ];
}
