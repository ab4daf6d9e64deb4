"use strict";
// The page's own part: tabs, keys, theme, and one channel to the server and back.
(() => {
  const $ = (id) => document.getElementById(id);
  let channel = null, asked = 0, wanted = [];

  function ask(what, more = {}) {
    const message = JSON.stringify({ ...more, do: what, n: ++asked });
    if (channel) channel.asked = message; else wanted.push([what, more]);
  }

  const shown = () => document.querySelector(".view.shown").id;

  function show(name, tell = true) {
    for (const view of document.querySelectorAll(".view"))
      view.classList.toggle("shown", view.id === name);
    for (const tab of document.querySelectorAll("nav button"))
      tab.setAttribute("aria-selected", String(tab.dataset.view === name));
    if (location.hash !== "#" + name) history.replaceState(null, "", "#" + name);
    plots.look(name);
    if (tell) ask("view", { name });
    window.dispatchEvent(new Event("resize"));
  }

  function patch(parts) {
    for (const [id, html] of Object.entries(parts)) {
      const place = $(id);
      if (!place) continue;
      const held = document.activeElement && document.activeElement.id;
      place.innerHTML = html.replaceAll(' style="', ' data-style="');  // the policy allows no other way
      for (const styled of place.querySelectorAll("[data-style]"))
        styled.style.cssText = styled.dataset.style;
      if (held && $(held)) $(held).focus();
      if (id === "seen") ask("seen", { number: Number(html) });
    }
  }

  // -- theme
  const system = matchMedia("(prefers-color-scheme: dark)");
  const chosen = () => localStorage.getItem("rtid-theme");  // by the user; else as the system
  let theme = chosen() || (system.matches ? "dark" : "light");

  system.addEventListener("change", () => {
    if (chosen()) return;
    theme = system.matches ? "dark" : "light";
    paintAll();
  });

  function paintAll() {
    document.documentElement.classList.toggle("dark", theme === "dark");
    plots.paint(theme);
  }

  // -- keys
  const KEYS = { z: ["drag", { mode: "zoom" }], s: ["drag", { mode: "span" }],
    r: ["next_run", {}], a: ["add", {}], u: ["undo", {}], Escape: ["forget", {}] };
  const MOVES = { 0: { whole: true }, "+": { factor: 0.5 }, "-": { factor: 2 },
    ArrowLeft: { share: -0.25 }, ArrowRight: { share: 0.25 } };
  document.addEventListener("keydown", (e) => {
    if (e.ctrlKey || e.metaKey || e.altKey || /^(INPUT|SELECT|TEXTAREA)$/.test(e.target.tagName))
      return;
    const tabs = [...document.querySelectorAll("nav button")];
    if (/^[1-9]$/.test(e.key) && tabs[e.key - 1]) show(tabs[e.key - 1].dataset.view);
    else if (e.key === "d") turn();
    else if (e.key === "?") $("keys").open ? $("keys").close() : $("keys").showModal();
    else if (KEYS[e.key] && !$("keys").open) ask(...KEYS[e.key]);
    else if (MOVES[e.key] && !$("keys").open) plots.move(shown(), MOVES[e.key]);
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
    else if (button.dataset.do === "go") show(button.dataset.name);
    else if (button.dataset.do === "whole") plots.move(shown(), { whole: true });
    else if (button.dataset.do) {
      const { do: what, ...more } = button.dataset;
      ask(what, more);
    }
  });
  document.addEventListener("dblclick", (e) => {
    if (e.target.closest(".bk")) plots.move(shown(), { whole: true });
  });
  document.addEventListener("change", (e) => {
    const { do: what, upload, ...more } = e.target.dataset || {};
    if (upload) [...e.target.files].forEach(send);
    else if (what) ask(what, { ...more, name: e.target.value });
  });

  // -- files come by a drop, as long as there is a door
  async function send(file) {
    $("work").textContent = `taking ${file.name} ...`;
    try {
      const answer = await fetch("arrive?name=" + encodeURIComponent(file.name),
        { method: "POST", body: file });
      $("work").textContent = answer.ok ? "" : await answer.text();
    } catch (error) { $("work").textContent = `${file.name} did not arrive`; }
  }
  for (const kind of ["dragover", "drop"])
    document.addEventListener(kind, (e) => {
      if (!document.querySelector(".arrival") || !e.dataTransfer.types.includes("Files")) return;
      e.preventDefault();
      if (kind === "drop") [...e.dataTransfer.files].forEach(send);
    });

  function drawn() {  // something new has been drawn
    plots.follow();
    paintAll();
    for (const place of document.querySelectorAll(".bk")) {  // a narrow page gives each plot a height
      const root = Bokeh.documents[0].get_model_by_id(place.firstElementChild.dataset.rootId);
      const figures = [...root.references()].filter((model) => model.type === "Figure");
      place.style.setProperty("--plots", Math.max(1, figures.length));
    }
  }

  // -- the channel is a model of Bokeh's document
  function attach() {
    const doc = window.Bokeh && Bokeh.documents[0];
    const found = doc && doc.get_model_by_name("channel");
    if (!found) return setTimeout(attach, 20);
    channel = found;
    found.properties.parts.change.connect(() => patch(found.parts));
    found.properties.show.change.connect(() => found.show && show(found.show.split(" ")[0], false));
    patch(found.parts);
    drawn();
    doc.on_change((event) => {
      if (event.kind === "ModelChanged" && event.attr === "children") { plots.follow(); setTimeout(drawn, 0); }
    });
    const view = location.hash.slice(1);
    show(document.querySelector(`nav [data-view="${view}"]`) ? view : document.body.dataset.first);
    for (const [what, more] of wanted.splice(0)) ask(what, more);
    document.body.dataset.ready = "yes";
  }
  document.documentElement.classList.toggle("dark", theme === "dark");
  plots.askForMore((view, low, high) => ask("zoom", { view, low, high }));
  plots.spareStyles();
  plots.clearWhole();
  plots.keepFitting();
  document.addEventListener("DOMContentLoaded", attach);

  // -- a page whose server has gone says so; it comes back once that one answers again, and asks no
  // more where another has taken its place: that has another token, which is in the address it prints
  document.addEventListener("DOMContentLoaded", () => {
    const asking = setInterval(() => {
      fetch("alive", { cache: "no-store" }).then(
        (r) => {
          if (r.status === 401) { clearInterval(asking); $("lost").hidden = false; }
          else if (!$("lost").hidden && r.ok) location.reload();
        },
        () => { $("lost").hidden = false; });
    }, 3000);
  });
})();
