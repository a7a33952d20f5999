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

async function draw(node) {
  const theme = document.documentElement.dataset.theme;
  const address = node.dataset.address;
  try {
    const [made, Plotly] = await Promise.all([
      api(`${address}${address.includes("?") ? "&" : "?"}theme=${theme}`), plotly()]);
    node.style.minHeight = `${made.layout.height}px`;
    await Plotly.react(node, made.data, made.layout, {
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
