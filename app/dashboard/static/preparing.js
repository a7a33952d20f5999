// While kernels are compiled, how far that has come; the line goes when calculations may begin.
const EVERY_MS = 1000;

const line = document.getElementById("preparing");
const bar = line.querySelector("progress");

async function follow() {
  try {
    const { kernels } = await (await fetch("/readyz")).json();
    if (kernels === "ok") return line.remove();
    const [, done, parts] = /(\d+) of (\d+)/.exec(kernels) ?? [];
    if (parts) [bar.max, bar.value] = [Number(parts), Number(done)];
  } catch { /* a server that does not answer is asked again */ }
  return setTimeout(follow, EVERY_MS);
}

follow();
