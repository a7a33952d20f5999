// What happens, as it happens: one stream of events for a whole page. Where it is lost, the page asks by itself, and says so.
const TYPES = ["session.received", "job.ended", "parameter_set.created", "parameter_set.activated", "attention.raised", "attention.cleared"];
const SLOWLY_MS = 60000;
const GATHER_MS = 250;
const AGAIN_MS = 10000;
const LOST_MS = 10000;

const readers = new Set();
const sign = document.getElementById("live");
let source = null;
let isLive = false;
let last = document.body.dataset.event ?? "";

function say() {
  if (!sign) return;
  const everyS = Math.min(...[...readers].map((one) => one.lostMs), LOST_MS) / 1000;
  sign.textContent = isLive ? "● live" : `◆ not live: asks every ${everyS} s`;
  sign.classList.toggle("watch", !isLive);
}

function turn(now) {
  if (now === isLive) return;
  isLive = now;
  say();
  for (const reader of readers) reader.plan();
}

// The stream begins behind what the page has brought; a browser that loses it goes on behind the last event it saw.
function open() {
  if (source || document.hidden) return;
  source = new EventSource(`/api/v1/events${last ? `?after=${encodeURIComponent(last)}` : ""}`);
  const mine = source;
  mine.addEventListener("open", () => turn(true));
  mine.addEventListener("error", () => {
    turn(false);
    if (!sign?.textContent) say();
    if (mine.readyState !== EventSource.CLOSED || mine !== source) return;
    // Refused, perhaps because what it asked for is no longer kept: then from now on.
    source = null;
    last = "";
    setTimeout(open, AGAIN_MS);
  });
  for (const type of TYPES) {
    mine.addEventListener(type, (event) => {
      last = event.lastEventId || last;
      const { data } = JSON.parse(event.data);
      for (const reader of readers) if (reader.types.has(type) && (!reader.satellite || data.satellite === reader.satellite)) reader.soon();
    });
  }
}

function close() {
  source?.close();
  source = null;
}

// A hidden page gives its connection back, for a browser has six a service; it goes on where it was.
document.addEventListener("visibilitychange", () => {
  if (document.hidden) close();
  else open();
});
addEventListener("pagehide", close);

// Runs `refresh` when one of `types` happens, and slowly besides, for ages grow by themselves; where the stream is lost, every `lostMs`.
export function live(refresh, { types = TYPES, satellite = null, lostMs = LOST_MS } = {}) {
  let timer = null;
  let isRunning = false;
  const reader = { types: new Set(types), satellite, lostMs,
    plan: () => { clearTimeout(timer); timer = setTimeout(run, isLive ? SLOWLY_MS : lostMs); },
    soon: () => { clearTimeout(timer); timer = setTimeout(run, GATHER_MS); } };
  async function run() {
    if (document.hidden || isRunning || document.querySelector("dialog[open]")) { reader.plan(); return; }
    isRunning = true;
    await Promise.resolve(refresh()).catch(() => {});
    isRunning = false;
    reader.plan();
  }
  readers.add(reader);
  reader.plan();
  if (document.hidden) return;
  requestAnimationFrame(() => setTimeout(open));
}
