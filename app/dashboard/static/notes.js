// Notes beside a thing: text, author, time; the newest first.
import { ago, api, h, may, section, time } from "./magcal.js";

const MOST = 50;

export function notes(path) {
  const place = h("div", { "aria-live": "polite" });
  const text = h("textarea", { id: "note-text", rows: 2, required: true, maxlength: 4000, placeholder: "What the next shift should know" });
  const fault = h("p", { class: "refuse", role: "alert" });

  async function draw() {
    const { items, next } = await api(`${path}/notes?limit=${MOST}`);
    place.replaceChildren(...items.map((note) => h("article", {}, h("p", { class: "muted" }, `${note.author ?? note.created_by ?? "–"}, `,
      h("span", { title: time(note.created_at) }, ago(note.created_at))), h("p", { class: "note" }, note.text))));
    if (!items.length) place.append(h("p", { class: "muted" }, "No note yet."));
    if (next) place.append(h("p", { class: "muted" }, `Only the newest ${MOST} are shown.`));
  }

  const form = h("form", { class: "inline", onsubmit: async (event) => {
    event.preventDefault();
    fault.textContent = "";
    try {
      await api(`${path}/notes`, { method: "POST", json: { text: text.value } });
      text.value = "";
      await draw();
    } catch (problem) {
      fault.textContent = problem.message;
    }
  } }, h("div", { class: "field" }, h("label", { for: "note-text" }, "New note"), text), h("button", {}, "Add note"), fault);
  draw().catch((problem) => place.replaceChildren(h("p", { class: "muted" }, problem.message)));
  return section("Notes", place, may("operate") ? form : null);
}
