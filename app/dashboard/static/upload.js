// Upload by drag and drop: what was wrong with a file stands at its rows.
import { api, field, h, option, problemTable, short } from "./magcal.js";

const TYPES = { csv: "text/csv", txt: "text/csv", tsv: "text/csv", json: "application/json", ndjson: "application/x-ndjson",
  jsonl: "application/x-ndjson", parquet: "application/vnd.apache.parquet" };

export function uploader(satellite, magnetometers) {
  const results = h("div", { "aria-live": "polite" });
  const input = h("input", { type: "file", multiple: true, id: "files", accept: ".csv,.tsv,.txt,.json,.ndjson,.jsonl,.parquet,.gz,.zst" });
  const magnetometer = h("select", { id: "magnetometer" }, magnetometers.map((one) => option(one.id, `${one.id} (${one.unit})`)));
  const area = h("div", { class: "drop" },
    h("label", { for: "magnetometer" }, "Magnetometer "), magnetometer,
    h("label", { for: "files" }, "Drop telemetry here, or choose files "), input,
    h("p", { class: "muted" }, "CSV, NDJSON, JSON columns or Parquet, also .gz and .zst. The same file again is the same session."));

  async function send(file) {
    const line = h("div", { class: "notice" }, `${file.name}: sending …`);
    results.prepend(line);
    try {
      const found = await post(satellite, magnetometer.value, file);
      const again = found.status === 200 ? " was there already" : "";
      line.className = "notice accept";
      line.replaceChildren(`${file.name}: `, h("a", { href: `/sessions/${found.body.id}` }, `session ${short(found.body.id)}`),
        `${again}, ${found.body.samples} samples, ${found.body.used_samples} usable. `,
        h("a", { href: `/sessions/${found.body.id}#calibrate`, class: "button" }, "Calibrate"));
    } catch (problem) {
      line.className = "";
      line.replaceChildren(h("p", {}, h("strong", {}, file.name), " was refused; nothing of it was kept."), problemTable(problem));
    }
  }

  const all = async (files) => { for (const file of files) await send(file); };
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

async function post(satellite, magnetometer, file) {
  const parts = file.name.toLowerCase().split(".");
  const packed = { gz: "gzip", zst: "zstd" }[parts.at(-1)];
  const type = TYPES[parts.at(packed ? -2 : -1)] ?? "text/csv";
  const headers = { "Content-Type": type, ...(packed ? { "Content-Encoding": packed } : {}) };
  let status = 0;
  const body = await api(`/satellites/${satellite}/sessions?magnetometer=${encodeURIComponent(magnetometer)}`,
    { method: "POST", body: file, headers, seen: (answer) => { status = answer.status; } });
  return { status, body };
}
