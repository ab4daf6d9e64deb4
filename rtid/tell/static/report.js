"use strict";
// The report's own part: everything is drawn once, and follows the system's theme.
plots.spareStyles();
plots.clearWhole();
plots.keepFitting();
(() => {
  const dark = matchMedia("(prefers-color-scheme: dark)");
  const paint = () => plots.paint(dark.matches ? "dark" : "light");
  const begin = () => {
    const places = [...document.querySelectorAll("[data-root-id]")];
    if (!places.every((place) => place.firstElementChild)) return setTimeout(begin, 20);
    plots.follow(); paint(); document.body.dataset.ready = "yes";
  };
  dark.addEventListener("change", paint);
  document.addEventListener("dblclick", () => plots.move("report", { whole: true }));
  document.addEventListener("DOMContentLoaded", begin);
})();
