// Set before the page is painted, so that a dark page never flashes white.
document.documentElement.dataset.theme =
  localStorage.getItem("magcal-theme") ?? (matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light");
