// Upload by drag and drop: what was wrong with a file stands at its rows, and how it is read can be chosen there.
import { lookAt } from "./columns.js";
import { api, h, option, problemTable, short } from "./magcal.js";
import { choices } from "./options.js";


export function uploader(satellite, magnetometers, sent = () => {}) {
  const results = h("div", { "aria-live": "polite" });
  const input = h("input", { type: "file", multiple: true, id: "files", accept: [...Object.keys(choices.types), ".gz", ".zst"].join(",") });
  const magnetometer = h("select", { id: "magnetometer" }, magnetometers.map((one) => option(one.id, `${one.id} (${one.unit})`)));
  const first = h("input", { type: "checkbox", id: "look-first" });
  const area = h("div", { class: "drop" },
    h("label", { for: "magnetometer" }, "Magnetometer "), magnetometer,
    h("label", { for: "files" }, "Drop telemetry here, or choose files "), input,
    h("label", { for: "look-first" }, first, " Look at the first rows before sending"),
    h("p", { class: "muted" }, "CSV, NDJSON, JSON columns or Parquet, also .gz and .zst. The same file again is the same session."));

  async function send(file, of, line) {
    line.className = "notice";
    line.replaceChildren(`${file.name}: sending …`);
    try {
      const found = await post(satellite, of, file);
      const again = found.status === 200 ? " was there already" : "";
      line.className = "notice accept";
      line.replaceChildren(`${file.name}: `, h("a", { href: `/sessions/${found.body.id}` }, `session ${short(found.body.id)}`),
        `${again}, ${found.body.samples} samples, ${found.body.used_samples} usable. `,
        h("a", { href: `/sessions/${found.body.id}#calibrate`, class: "button" }, "Calibrate"));
      sent();
    } catch (problem) {
      line.className = "";
      const isOfTheFile = problem.body?.status === 422;
      line.replaceChildren(h("p", {}, h("strong", {}, file.name), " was refused; nothing of it was kept."), problemTable(problem),
        h("p", {}, isOfTheFile ? h("button", { type: "button", onclick: () => look(file, of, line) }, "Choose its columns, unit and times …") : null, clear(file, line)));
    }
  }

  function look(file, of, line) {
    line.className = "";
    line.replaceChildren(clear(file, line), lookAt({ satellite, magnetometer: magnetometers.find((one) => one.id === of), file, headers: headersOf(file), send: () => send(file, of, line) }));
  }

  // What was said of a file goes with one click; nothing of the file was kept.
  const clear = (file, line) => h("button", { type: "button", class: "quiet", "aria-label": `Clear ${file.name}`, onclick: () => line.remove() }, "Clear");

  async function all(files) {
    for (const file of files) {
      const line = h("div");
      results.prepend(line);
      if (first.checked) look(file, magnetometer.value, line);
      else await send(file, magnetometer.value, line);
    }
  }

  input.addEventListener("change", () => { all([...input.files]).then(() => { input.value = ""; }); });
  area.addEventListener("dragover", (event) => { event.preventDefault(); area.classList.add("over"); });
  area.addEventListener("dragleave", () => area.classList.remove("over"));
  area.addEventListener("drop", (event) => {
    event.preventDefault();
    area.classList.remove("over");
    all([...event.dataTransfer.files]);
  });
  return h("div", {}, area, results);
}

function headersOf(file) {
  const parts = file.name.toLowerCase().split(".");
  const packed = { gz: "gzip", zst: "zstd" }[parts.at(-1)];
  const type = choices.types[`.${parts.at(packed ? -2 : -1)}`] ?? "text/csv";
  return { "Content-Type": type, ...(packed ? { "Content-Encoding": packed } : {}) };
}

async function post(satellite, magnetometer, file) {
  let status = 0;
  const body = await api(`/satellites/${satellite}/sessions?magnetometer=${encodeURIComponent(magnetometer)}`,
    { method: "POST", body: file, headers: headersOf(file), seen: (answer) => { status = answer.status; } });
  return { status, body };
}
