"use strict";
// The page's own part: tabs, keys, theme, and one channel to the server and back.
(() => {
  const $ = (id) => document.getElementById(id);
  let channel = null, asked = 0, wanted = [];

  function ask(what, more = {}) {
    const message = JSON.stringify({ ...more, do: what, n: ++asked });
    if (channel) channel.asked = message; else wanted.push([what, more]);
  }

  function show(name, tell = true) {
    for (const view of document.querySelectorAll(".view"))
      view.classList.toggle("shown", view.id === name);
    for (const tab of document.querySelectorAll("nav button"))
      tab.setAttribute("aria-selected", String(tab.dataset.view === name));
    if (location.hash !== "#" + name) history.replaceState(null, "", "#" + name);
    if (tell) ask("view", { name });
    window.dispatchEvent(new Event("resize"));
  }

  function patch(parts) {
    for (const [id, html] of Object.entries(parts)) {
      const place = $(id);
      if (!place) continue;
      const held = document.activeElement && document.activeElement.id;
      place.innerHTML = html;
      if (held && $(held)) $(held).focus();
      if (id === "seen") ask("seen", { number: Number(html) });
    }
  }

  // -- theme: what belongs to the page, not to the data, follows it
  const INK = { light: "#22272b", dark: "#e3e6e8" }, QUIET = { light: "#5c656c", dark: "#a3abb1" };
  const LINE = { light: "#d9dde0", dark: "#3a4146" }, CARD = { light: "#ffffff", dark: "#1d2327" };
  let theme = localStorage.getItem("rtid-theme") ||
    (matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light");

  function paint(model) {
    const ink = INK[theme], quiet = QUIET[theme];
    const glyph = model.tags.includes("ink") && !model.type.endsWith("Annotation");
    const set = (values) => {
      const own = Object.entries(values).filter(([key]) => key in model.properties)
        .map(([key, value]) => [key, glyph ? { value } : value]);
      model.setv(Object.fromEntries(own), { sync: false });  // the server need not know
    };
    if (model.type.endsWith("Axis"))
      set({ axis_label_text_color: quiet, major_label_text_color: quiet, axis_line_color: quiet,
            major_tick_line_color: quiet });
    else if (model.type === "Grid") set({ grid_line_color: LINE[theme] });
    else if (model.type === "Title") set({ text_color: ink });
    else if (model.type === "Legend")
      set({ label_text_color: quiet, background_fill_color: CARD[theme] });
    else if (model.type === "ColorBar") set({ major_label_text_color: quiet,
      title_text_color: quiet, background_fill_alpha: 0 });
    else if (model.type === "BoxAnnotation" && model.tags[0])
      set({ fill_color: model.tags[0][theme] });
    if (glyph) set({ line_color: ink, text_color: ink, fill_color: ink });
  }

  // data colours that would be dim on a dark ground have a lighter twin
  const TWINS = [["#0072b2", "#56b4e9"], ["#d55e00", "#f5995b"]];

  function twin(model) {
    for (const key of ["line_color", "fill_color"]) {
      const own = model.properties[key] && model[key], colour = own && (own.value || own);
      const pair = TWINS.find((two) => two.includes(colour));
      if (!pair) continue;
      const now = pair[theme === "dark" ? 1 : 0];
      if (now !== colour)
        model.setv({ [key]: own.value ? { value: now } : now }, { sync: false });
    }
  }

  function paintAll() {
    document.documentElement.classList.toggle("dark", theme === "dark");
    for (const doc of (window.Bokeh ? Bokeh.documents : []))
      for (const model of doc.all_models) { paint(model); twin(model); }
  }

  // -- keys
  const KEYS = { z: ["drag", { mode: "zoom" }], s: ["drag", { mode: "span" }], 0: ["whole", {}],
    r: ["next_run", {}], a: ["add", {}], u: ["undo", {}], "+": ["zoom", { factor: 0.5 }],
    "-": ["zoom", { factor: 2 }], ArrowLeft: ["pan", { share: -0.25 }],
    ArrowRight: ["pan", { share: 0.25 }], Escape: ["forget", {}] };
  document.addEventListener("keydown", (e) => {
    if (e.ctrlKey || e.metaKey || e.altKey || /^(INPUT|SELECT|TEXTAREA)$/.test(e.target.tagName))
      return;
    const tabs = [...document.querySelectorAll("nav button")];
    if (/^[1-9]$/.test(e.key) && tabs[e.key - 1]) show(tabs[e.key - 1].dataset.view);
    else if (e.key === "d") turn();
    else if (e.key === "?") $("keys").open ? $("keys").close() : $("keys").showModal();
    else if (KEYS[e.key] && !$("keys").open) ask(...KEYS[e.key]);
    else return;
    e.preventDefault();
  });

  function turn() {
    theme = theme === "dark" ? "light" : "dark";
    localStorage.setItem("rtid-theme", theme);
    paintAll();
  }

  document.addEventListener("click", (e) => {
    const button = e.target.closest && e.target.closest("button");
    if (!button || button.disabled) return;
    if (button.dataset.view) show(button.dataset.view);
    else if (button.id === "theme") turn();
    else if (button.id === "help") $("keys").showModal();
    else if (button.dataset.close) button.closest("dialog").close();
    else if (button.dataset.do) {
      const { do: what, ...more } = button.dataset;
      ask(what, more);
    }
  });
  document.addEventListener("change", (e) => {
    if (e.target.dataset && e.target.dataset.do)
      ask(e.target.dataset.do, { name: e.target.value });
  });

  // -- the channel is a model of Bokeh's document
  function attach() {
    const doc = window.Bokeh && Bokeh.documents[0];
    const found = doc && doc.get_model_by_name("channel");
    if (!found) return setTimeout(attach, 20);
    channel = found;
    found.properties.parts.change.connect(() => patch(found.parts));
    found.properties.show.change.connect(() => found.show && show(found.show.split(" ")[0], false));
    patch(found.parts);
    paintAll();
    doc.on_change((event) => {
      if (event.kind === "ModelChanged" && event.attr === "children") setTimeout(paintAll, 0);
    });
    const view = location.hash.slice(1);
    show(document.querySelector(`nav [data-view="${view}"]`) ? view : document.body.dataset.first);
    for (const [what, more] of wanted.splice(0)) ask(what, more);
    document.body.dataset.ready = "yes";
  }
  document.documentElement.classList.toggle("dark", theme === "dark");
  document.addEventListener("DOMContentLoaded", attach);

  // -- a page whose server has gone says so, and comes back by itself
  document.addEventListener("DOMContentLoaded", () => setInterval(() => {
    fetch("alive", { cache: "no-store" }).then(
      (r) => { if (!$("lost").hidden && r.ok) location.reload(); },
      () => { $("lost").hidden = false; });
  }, 3000));
})();
