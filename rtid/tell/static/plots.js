"use strict";
// What plots do in the browser, on the page and in the report alike: lines are thinned to what is
// seen of them, plots over time are zoomed together, and colours follow the theme.
const plots = (() => {
  const ROOM_PX = 4;  // right of a title
  const all = () => (window.Bokeh ? Bokeh.documents : []).flatMap((doc) => [...doc.all_models]);

  // Bokeh asks the style sheets for the colour of every tick at every painting; ours name none.
  function spareStyles() {
    try {
      Bokeh.require("core/visuals/visual").VisualProperties.prototype._get_css_value = () => "";
    } catch { /* another Bokeh: slower, the same picture */ }
  }

  // Bokeh clears a canvas from the middle of its first pixels on: a title that once was higher than
  // its place would be seen along the edge for ever.
  function clearWhole() {
    try {
      Bokeh.require("core/util/canvas").CanvasLayer.prototype.clear = function () {
        const { x, y, width, height } = this.bbox;
        this.ctx.clearRect(x - 1, y - 1, width + 2, height + 2);
      };
    } catch { /* another Bokeh */ }
  }

  // -- lines: a source with the tags [whole, name, detail] draws the column `name` of the source
  // `detail`, a window of the record, where that spans what is seen, else of the source `whole`.
  // Where its name says that it is thinned, more of what is seen is asked for.
  function first(t, at, past) {  // index of the first time that is not before (past: is after) `at`
    let low = 0, high = t.length;
    while (low < high) {
      const middle = (low + high) >> 1;
      if (past ? t[middle] <= at : t[middle] < at) low = middle + 1; else high = middle;
    }
    return low;
  }

  // The least and the largest value of every bin, in their order, and where the line is broken.
  function between(t, y, low, high, bins) {
    const from = Math.max(0, first(t, low, false) - 1);
    const to = Math.min(t.length, first(t, high, true) + 1), n = to - from;
    if (n <= 2 * bins) return [t.slice(from, to), y.slice(from, to)];
    const chosen = [], newest = () => chosen[chosen.length - 1];
    const take = (i) => { if (i >= 0 && i !== newest()) chosen.push(i); };
    let least = -1, most = -1;
    const takeBoth = () => {
      take(Math.min(least, most));
      take(Math.max(least, most));
      least = most = -1;
    };
    take(from);
    for (let bin = 0; bin < bins; bin++) {
      const end = from + Math.floor((bin + 1) * n / bins);
      for (let i = from + Math.floor(bin * n / bins); i < end; i++) {
        const value = y[i];
        if (value !== value) {  // broken here: what lies before is not joined to what lies behind
          takeBoth();
          if (y[newest()] === y[newest()]) take(i);
          continue;
        }
        if (least < 0 || value < y[least]) least = i;
        if (most < 0 || value > y[most]) most = i;
      }
      takeBoth();
    }
    take(to - 1);
    return [Float64Array.from(chosen, (i) => t[i]), Float64Array.from(chosen, (i) => y[i])];
  }

  const binsSeen = () => Math.max(400, Math.round(window.innerWidth / 2));

  function spans(detail, whole, range) {
    const t = detail.data.t, all = whole.data.t, last = all.length - 1;
    return t.length > 1 && t[0] <= Math.max(range.start, all[0]) &&
      t[t.length - 1] >= Math.min(range.end, all[last]);
  }

  function thin(drawn, range) {
    const [whole, name, detail] = drawn.tags, from = spans(detail, whole, range) ? detail : whole;
    const { t, [name]: y } = from.data, bins = binsSeen();
    const [seenT, seenY] = y ? between(t, y, range.start, range.end, bins) : [[], []];
    drawn.setv({ data: { t: seenT, y: seenY } }, { sync: false });
    const seen = y ? first(t, range.end, true) - first(t, range.start, false) : 0;
    if (from.name === "thinned" && seen < 2 * bins) wantMore(range);
  }

  const MARGIN = 0.5, CALM_MS = 40;  // of what is seen, at either side; of no further zoom
  let more = null, waiting = 0, wanted = "";  // who is asked, when, and for what the last time

  function wantMore({ name, start, end }) {
    const view = name.replace("time_", ""), margin = MARGIN * (end - start);
    clearTimeout(waiting);
    waiting = setTimeout(() => {
      const what = `${view} ${start} ${end}`;
      if (more && what !== wanted) more(view, start - margin, end + margin);
      wanted = what;
    }, CALM_MS);
  }

  const askForMore = (whom) => { more = whom; };

  // -- room: a title takes as many lines as it needs, figures in blocks stand where they fit
  const pen = document.createElement("canvas").getContext("2d");
  const wide = (words, font) => { pen.font = font; return pen.measureText(words).width; };

  function broken(words, font, room) {
    const lines = [];
    for (const word of words.split(" ")) {
      const longer = lines.length ? `${lines[lines.length - 1]} ${word}` : word;
      if (!lines.length || wide(longer, font) > room) lines.push(word);
      else lines[lines.length - 1] = longer;
    }
    return lines.join("\n");
  }

  const told = new Map();  // a title: its words, how they are shown, and in what width

  const titles = ({ title, above }) => [title, ...above.filter(({ type }) => type === "Title")];

  function wrap(view, title) {
    const outer = view.bbox.width, known = told.get(title);
    const isKnown = known && known.shown === title.text;
    if (isKnown && known.outer === outer) return;
    const words = isKnown ? known.words : title.text;
    const font = `${title.text_font_style} ${title.text_font_size} ${title.text_font}`;
    const shown = broken(words, font, outer - view.frame.bbox.left - ROOM_PX);
    told.set(title, { words, shown, outer });
    if (shown === title.text) return;
    title.setv({ text: shown }, { sync: false });
    setTimeout(() => view.request_layout(true));  // another number of lines
  }

  function place({ glyph, data_source: drawn }, across, down) {  // across, down: pixels of a block
    const size = glyph.text_font_size.value, font = `${size} ${glyph.text_font.value}`;
    const width = Math.max(0, ...[...drawn.data.text].map((words) => wide(words, font)));
    const height = parseFloat(size), isLevel = width <= across && height <= down;
    const fits = isLevel || (width <= down && height <= across);
    glyph.setv({ angle: { value: isLevel ? 0 : Math.PI / 2 }, text_alpha: { value: fits ? 1 : 0 } },
      { sync: false });
  }

  const isFigures = ({ glyph }) => Boolean(glyph) && glyph.tags.includes("figures");

  function fit(view) {
    const { x_range: x, y_range: y, renderers } = view.model, { width, height } = view.frame.bbox;
    for (const title of titles(view.model)) wrap(view, title);
    for (const one of renderers.filter(isFigures))
      place(one, width / (x.end - x.start), height / (y.end - y.start));
  }

  const fitted = new WeakSet();

  function fitFromNowOn(view) {
    if (fitted.has(view)) return;
    fitted.add(view);
    for (const title of titles(view.model))
      title.properties.text.change.connect(() => fit(view));
    for (const one of view.model.renderers.filter(isFigures))
      one.data_source.properties.data.change.connect(() => fit(view));
  }

  function keepFitting() {
    try {
      const { prototype } = Bokeh.require("models/plots/plot_canvas").PlotView;
      const laidOut = prototype._after_layout;
      prototype._after_layout = function () {
        laidOut.call(this);
        fitFromNowOn(this);
        fit(this);
      };
    } catch { /* another Bokeh: long titles are cut on narrow pages */ }
  }

  // -- time: every view has a range of its own, which takes over what the one before has seen
  const known = new Map();  // a range over time, and the sources that are drawn along it
  let seen = null;

  function zoomTo(range, start, end) {
    const [low, high] = range.bounds, width = Math.min(end - start, high - low);
    start = Math.min(Math.max(start, low), high - width);
    range.setv({ start, end: start + width });
  }

  function follow() {  // whatever has been added to the documents
    for (const plot of all()) {
      const range = plot.type === "Figure" ? plot.x_range : null;
      if (!range || !range.tags.includes("time")) continue;
      if (!known.has(range)) {
        known.set(range, new Set());
        range.change.connect(() => {
          seen = [range.start, range.end];
          for (const drawn of known.get(range)) thin(drawn, range);
        });
        if (seen) zoomTo(range, ...seen);
      }
      for (const { data_source: drawn } of plot.renderers) {
        if (!drawn || !drawn.tags[1] || known.get(range).has(drawn)) continue;
        known.get(range).add(drawn);
        for (const source of [drawn.tags[0], drawn.tags[2]])
          source.properties.data.change.connect(() => thin(drawn, range));
        thin(drawn, range);
      }
    }
  }

  const rangeOf = (view) => [...known.keys()].find((range) => range.name === `time_${view}`);

  function look(view) {  // at the same time of the record as in the view before
    const range = rangeOf(view);
    if (range && seen && (range.start !== seen[0] || range.end !== seen[1])) zoomTo(range, ...seen);
  }

  function move(view, { factor = 1, share = 0, whole = false }) {  // in, out, along, or all of it
    const range = rangeOf(view);
    if (!range) return;
    if (whole) { zoomTo(range, ...range.bounds); return; }
    const width = range.end - range.start, middle = (range.start + range.end) / 2 + share * width;
    zoomTo(range, middle - factor * width / 2, middle + factor * width / 2);
  }

  // -- theme: what belongs to the page, not to the data, follows it
  const INK = { light: "#22272b", dark: "#e3e6e8" }, QUIET = { light: "#5c656c", dark: "#a3abb1" };
  const LINE = { light: "#d9dde0", dark: "#3a4146" }, CARD = { light: "#ffffff", dark: "#1d2327" };

  function paintOne(model, theme) {
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
    else if (model.type === "Title" && !model.tags.includes("note")) set({ text_color: ink });
    else if (model.type === "Legend")
      set({ label_text_color: quiet, background_fill_color: CARD[theme] });
    else if (model.type === "ColorBar") set({ major_label_text_color: quiet,
      title_text_color: quiet, background_fill_alpha: 0 });
    if (glyph) set({ line_color: ink, text_color: ink, fill_color: ink });
  }

  // data colours that would be dim on a dark ground have a lighter twin
  const TWINS = [["#0072b2", "#56b4e9"], ["#d55e00", "#f5995b"]];

  function twin(model, theme) {
    for (const key of ["line_color", "fill_color", "text_color"]) {
      const own = model.properties[key] && model[key], colour = own && (own.value || own);
      const pair = TWINS.find((two) => two.includes(colour));
      if (!pair) continue;
      const now = pair[theme === "dark" ? 1 : 0];
      if (now !== colour)
        model.setv({ [key]: own.value ? { value: now } : now }, { sync: false });
    }
  }

  function paint(theme) {
    for (const model of all()) { paintOne(model, theme); twin(model, theme); }
  }

  return { askForMore, between, clearWhole, follow, keepFitting, look, move, paint, spareStyles };
})();
