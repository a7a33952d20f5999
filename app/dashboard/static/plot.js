// Figures: made in Python, drawn here, once the page has its numbers and the figure is near the screen.
import { api, h, problemTable } from "./magcal.js";

let library = null;

function plotly() {
  library ??= new Promise((resolve, reject) => {
    const script = h("script", { src: document.body.dataset.plotly, onload: () => resolve(window.Plotly), onerror: reject });
    document.head.append(script);
  });
  return library;
}

const awaited = new WeakMap();
const near = new IntersectionObserver((entries) => {
  for (const { isIntersecting, target } of entries) {
    if (!isIntersecting) continue;
    near.unobserve(target);
    awaited.get(target)();
    awaited.delete(target);
  }
}, { rootMargin: "600px" });

// Once the page has its numbers and the node is near the screen.
export function whenNear(node, act) {
  awaited.set(node, act);
  near.observe(node);
}

const NARROW_PX = 560;
const PANEL_PX = 170;

// Panels of a figure that stand beside each other over time, three a row, stand below each other where there is no room.
function fitting(layout, width) {
  const numbers = Object.keys(layout).filter((name) => /^xaxis\d*$/.test(name)).map((name) => name.slice(5));
  const isBeside = numbers.length > 3 && numbers.every((n) => layout[`xaxis${n}`].type === "date" && layout[`xaxis${n}`].domain?.[1] - layout[`xaxis${n}`].domain?.[0] < 0.4);
  if (width >= NARROW_PX || !isBeside) return layout;
  const share = 1 / numbers.length;
  const made = { ...layout, height: PANEL_PX * numbers.length };
  numbers.sort((a, b) => Number(a || 1) - Number(b || 1)).forEach((n, i) => {
    const top = 1 - i * share;
    made[`xaxis${n}`] = { ...layout[`xaxis${n}`], domain: [0, 1] };
    made[`yaxis${n}`] = { ...layout[`yaxis${n}`], domain: [top - 0.55 * share, top] };
  });
  made.annotations = layout.annotations.map((one, i) => ({ ...one, x: 0, y: 1 - i * share + 0.002 }));
  return made;
}

async function draw(node) {
  const theme = document.documentElement.dataset.theme;
  const address = node.dataset.address;
  try {
    const [made, Plotly] = await Promise.all([
      api(`${address}${address.includes("?") ? "&" : "?"}theme=${theme}`), plotly()]);
    const layout = fitting(made.layout, node.clientWidth);
    node.style.minHeight = `${layout.height}px`;
    await Plotly.react(node, made.data, layout, {
      responsive: true, displaylogo: false, showSendToCloud: false, plotlyServerURL: "", modeBarButtonsToRemove: ["select2d", "lasso2d", "autoScale2d"],
      toImageButtonOptions: { scale: 2 } });
    node.dataset.drawn = theme;
    node.removeAttribute("aria-busy");
  } catch (problem) {
    node.removeAttribute("aria-busy");
    node.dataset.drawn = "failed";
    node.replaceChildren(problemTable(problem));
  }
}

export function plot(address, heading, caption, height = 360) {
  const node = h("div", { class: "plot", role: "group", "aria-label": heading, "aria-busy": "true", "data-address": address });
  node.style.minHeight = `${height}px`;
  whenNear(node, () => draw(node));
  return h("figure", {}, h("h3", {}, heading), node, caption ? h("figcaption", {}, caption) : null);
}

export function replot(figure, address) {
  const node = figure.querySelector(".plot");
  node.dataset.address = address;
  if (node.dataset.drawn) draw(node);
}

document.addEventListener("magcal-theme", () => {
  for (const node of document.querySelectorAll(".plot[data-drawn]")) draw(node);
});
