// One job, live: server-sent events until it has ended.
import { api, h, notice, problemTable, state } from "./magcal.js";

export const ENDED = new Set(["succeeded", "failed", "cancelled"]);

export function watch(id, changed) {
  const source = new EventSource(`/api/v1/jobs/${id}/events`);
  const take = (event) => {
    const job = JSON.parse(event.data);
    if (ENDED.has(job.state)) source.close();
    changed(job);
  };
  for (const name of ["queued", "running", "succeeded", "failed", "cancelled"]) source.addEventListener(name, take);
  return source;
}

export async function cancel(job) {
  await api(`/jobs/${job.id}/cancel`, { method: "POST" });
}

// The same request again; the new job is a job of its own.
export async function retry(job) {
  return api(`/jobs/${job.id}/retry`, { method: "POST" });
}

export function follow(job, ended) {
  const bar = h("progress", { max: 1, value: job.progress, "aria-label": "Progress" });
  const text = h("span", {}, state(job.state));
  const stop = h("button", { type: "button", onclick: () => cancel(job).catch((problem) => notice(problem.message, "refuse")) }, "Cancel");
  const faults = h("div");
  const node = h("div", { class: "job" }, bar, text, stop, faults);
  watch(job.id, (now) => {
    bar.value = now.state === "succeeded" ? 1 : now.progress;
    text.replaceChildren(state(now.state));
    if (!ENDED.has(now.state)) return;
    stop.remove();
    if (now.error) faults.replaceChildren(problemTable({ body: now.error }));
    ended(now);
  });
  return node;
}
