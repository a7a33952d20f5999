// A magnetometer's state at a glance.
import { age, grade, h, nt, tiles, time } from "./magcal.js";

export const magnetometerPage = (satellite, magnetometer) => `/satellites/${satellite}/magnetometers/${encodeURIComponent(magnetometer)}`;

export function statusOf(row, { isAlone = false } = {}) {
  return [isAlone ? null : h("h2", {}, h("a", { href: magnetometerPage(row.satellite, row.magnetometer) }, row.magnetometer)), tiles(
    ["active set", row.active ? h("a", { href: `/parameter-sets/${row.active.id}` }, grade(row.active.grade)) : "none", row.active ? row.active.method : null],
    ["its data's age", age(row.active?.data_until), row.active ? time(row.active.data_until) : null],
    ["its residual", nt(row.active?.rms_nt), row.active?.cross_validated_rms_nt ? `cross-validated ${nt(row.active.cross_validated_rms_nt)}` : null],
    ["last session", row.last_session ? h("a", { href: `/sessions/${row.last_session.id}` }, age(row.last_session.data_until)) : "none",
      row.last_session ? `${row.last_session.samples} samples` : null],
    isAlone ? null : ["good for", h("span", { "data-life": row.magnetometer }, "–")],
    ["jobs waiting or running", String(row.jobs_waiting)])];
}
