// Keys: made, listed, revoked; and who did what.
import { api, confirm, field, form, h, listed, notice, section, short, show, start, time } from "./magcal.js";
import { live } from "./live.js";
import { table } from "./table.js";

const SCOPES = [["read", "see everything"], ["ingest", "send telemetry and orbits"], ["operate", "calibrate, activate, add satellites"], ["admin", "all of it, and keys"]];

function create(again) {
  const place = h("div", { "aria-live": "polite" });
  const boxes = h("fieldset", {}, h("legend", {}, "Scopes"), SCOPES.map(([name, text]) =>
    h("label", {}, h("input", { type: "checkbox", name: `scope-${name}`, checked: name === "read" }), ` ${name}: ${text}`)));
  const node = form([field("name", "Name", { placeholder: "ground station north" }),
    field("satellites", "Only for these satellites (comma)", { placeholder: "all" }),
    field("expires_at", "Expires (UTC)", { type: "datetime-local" }), boxes], "Create key", async (values) => {
    const body = { scopes: SCOPES.map(([name]) => name).filter((name) => values[`scope-${name}`]) };
    if (values.name) body.name = values.name;
    const satellites = values.satellites.split(",").map((one) => one.trim()).filter(Boolean);
    if (satellites.length) body.satellites = satellites;
    if (values.expires_at) body.expires_at = new Date(`${values.expires_at}Z`).toISOString();
    const made = await api("/keys", { method: "POST", json: body });
    place.replaceChildren(h("div", { class: "notice accept" }, h("p", {}, "The key is shown this once. Copy it now:"), h("code", { class: "secret" }, made.key)));
    again();
  });
  return [node, place];
}

// Where the page of an audit line's subject is, by what was done; null where it has none.
const PAGES = {
  session: ({ subject }) => `/sessions/${subject}`,
  parameter_set: ({ subject }) => `/parameter-sets/${subject}`,
  job: ({ subject }) => `/jobs?q=${subject}`,
  satellite: ({ subject, action }) => (action === "satellite.remove" ? null : `/satellites/${subject}`),
  magnetometer: ({ subject, satellite_id: satellite }) => `/satellites/${satellite}/magnetometers/${subject}`,
  orbit: ({ satellite_id: satellite }) => (satellite ? `/satellites/${satellite}#orbits` : null),
};

function subjectOf(row, names) {
  const kind = row.action.split(".")[0];
  const page = PAGES[kind]?.(row);
  if (names.has(row.subject)) return names.get(row.subject);
  const said = /^[0-9a-f]{32}$/.test(row.subject) ? short(row.subject) : row.subject;
  return page ? h("a", { href: page, title: row.subject }, said) : said;
}

start(async () => {
  const list = h("div");
  const names = new Map();
  let drawn = null;
  async function draw() {
    const keys = await listed("/keys");
    for (const key of keys) names.set(key.id, key.name ?? key.id);
    if (drawn?.renew) {
      drawn.renew(keys);
      return;
    }
    drawn = table([
      { name: "key", value: (r) => r.id, show: (r) => h("code", {}, r.id) },
      { name: "name", value: (r) => r.name },
      { name: "scopes", value: (r) => r.scopes.join(" ") },
      { name: "satellites", value: (r) => r.satellites?.join(" ") ?? "all" },
      { name: "created", value: (r) => r.created_at, show: (r) => time(r.created_at) },
      { name: "expires", value: (r) => r.expires_at, show: (r) => r.expires_at ? time(r.expires_at) : "never" },
      { name: "state", value: (r) => (r.revoked_at ? "revoked" : "in force") },
      { name: "action", value: () => "", show: (r) => r.revoked_at ? "" : h("button", { type: "button", onclick: () => revoke(r) }, "Revoke") },
    ], keys, { caption: "Keys", file: "keys" });
    list.replaceChildren(drawn);
  }
  async function revoke(key) {
    const sure = await confirm("Revoke this key?", h("p", {}, `${key.name ?? key.id} (${key.scopes.join(", ")}) stops working at the next request. This cannot be undone.`), "Revoke");
    if (!sure) return;
    await api(`/keys/${key.id}/revoke`, { method: "POST" }).catch((problem) => notice(problem.message, "refuse"));
    await draw();
  }
  const audit = section("Audit trail", h("p", { class: "muted" }, "Loading …"));
  show(h("h1", {}, "Keys"), list, section("New key", ...create(draw)), audit);
  let trail = null;
  async function drawAudit() {
    const events = await listed("/audit", 500);
    if (trail) {
      trail.renew(events);
      return;
    }
    trail = table([
      { name: "time", value: (r) => r.at, show: (r) => time(r.at) },
      { name: "action", value: (r) => r.action },
      { name: "subject", value: (r) => names.get(r.subject) ?? r.subject, show: (r) => subjectOf(r, names) },
      { name: "satellite", value: (r) => r.satellite_id, show: (r) => r.satellite_id ? h("a", { href: `/satellites/${r.satellite_id}` }, r.satellite_id) : "–" },
      { name: "by", value: (r) => names.get(r.key_id) ?? r.key_id, show: (r) => h("span", { title: r.key_id }, names.get(r.key_id) ?? r.key_id ?? "–") },
      { name: "reason", value: (r) => r.reason },
      { name: "address", value: (r) => r.address },
    ], events, { caption: "Audit trail", file: "audit" });
    audit.replaceChildren(audit.firstChild, trail);
  }
  await draw();
  await drawAudit();
  live(() => draw().then(drawAudit));
});
