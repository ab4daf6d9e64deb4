// What a user would complain of, as sentences: whatever is drawn and has no area, lies outside the
// window, is cut, lies under or over something else, or can hardly be told from its ground.
() => {
  const LEAST_CONTRAST = 4.5, LEAST_SCROLLED = 150, SLACK = 1.5;
  const W = document.documentElement.clientWidth, H = innerHeight;
  const found = new Set(), say = (words) => found.add(words);
  const up = (el) => el.parentElement || (el.getRootNode().host ?? null);
  const name = (el) => {
    const own = el.closest("[id]"), id = own ? `#${own.id}` : "";
    const words = (el.textContent || "").trim().replace(/\s+/g, " ").slice(0, 50);
    return `${id} <${el.localName}${el.className && el.className.trim ? "." + el.className.trim().split(/\s+/).join(".") : ""}> "${words}"`;
  };
  const above = (el) => { const all = []; for (let p = el; p; p = up(p)) all.push(p); return all; };
  const related = (a, b) => above(a).includes(b) || above(b).includes(a);
  const cap = (a, b) => ({ l: Math.max(a.l, b.l), t: Math.max(a.t, b.t), r: Math.min(a.r, b.r), b: Math.min(a.b, b.b) });
  const boxOf = (r) => ({ l: r.left, t: r.top, r: r.right, b: r.bottom });
  const hasArea = (b) => b.r - b.l > 0.5 && b.b - b.t > 0.5;
  const inside = (el) => {  // the part of it that shows what it holds
    const r = el.getBoundingClientRect();
    return { l: r.left + el.clientLeft, t: r.top + el.clientTop,
             r: r.left + el.clientLeft + el.clientWidth, b: r.top + el.clientTop + el.clientHeight };
  };

  // -- what is drawn: lines of text, controls, pictures
  const CONTROLS = new Set(["button", "select", "input", "progress", "svg", "img", "textarea"]);
  const things = [];
  const top = document.querySelector("dialog[open]") || document.body;
  const walk = (el) => {
    if (["script", "style", "option", "title", "noscript", "template"].includes(el.localName)) return;
    if (!el.checkVisibility({ opacityProperty: true, visibilityProperty: true })) return;
    if (el.classList.contains("bk-Tooltip")) return;  // follows the pointer, over whatever is there
    const style = getComputedStyle(el), is = (kind) => el.classList.contains(kind);
    if (CONTROLS.has(el.localName) || is("bk-Figure"))
      things.push({ el, kind: is("bk-Figure") ? "plot" : "control", box: boxOf(el.getBoundingClientRect()) });
    if (is("bk-Figure")) return;
    for (const node of el.childNodes) {
      if (node.nodeType === Node.TEXT_NODE && node.data.trim() && el.localName !== "select") {
        const range = document.createRange();
        range.selectNodeContents(node);
        const lines = [...range.getClientRects()].map(boxOf).filter(hasArea);
        if (!lines.length) say(`has no area: ${name(el)}`);
        for (const box of lines) things.push({ el, kind: "text", box, style });
      }
    }
    for (const child of (el.shadowRoot || el).children) walk(child);
    if (el.shadowRoot) for (const child of el.children) walk(child);
  };
  walk(top);

  // -- words of a table are broken between letters only where they are long (digests, paths)
  const LONGEST = 16;
  for (const cell of new Set(things.filter((t) => t.kind === "text").map((t) => t.el.closest("td")).filter(Boolean))) {
    if (cell.querySelector("*")) continue;
    const most = cell.textContent.trim().split(/[\s-]+/).reduce((all, w) => all + Math.max(1, Math.ceil(w.length / LONGEST)), 0);
    const range = document.createRange(); range.selectNodeContents(cell);
    const tops = new Set([...range.getClientRects()].map((r) => Math.round(r.top)));
    if (tops.size > most) say(`is broken into letters, ${tops.size} lines: ${name(cell)}`);
  }

  // -- inside the window, or to be scrolled to; not cut
  const pageScrolls = !/hidden|clip/.test(getComputedStyle(document.body).overflowY);
  for (const one of things) {
    const { el, kind, box } = one;
    one.seen = { ...box };
    if (!hasArea(box)) { say(`has no area: ${name(el)}`); continue; }
    const chain = above(el), told = chain.some((p) => p.title);
    let reach = box, isFixed = false;
    for (const p of chain) {
      const style = getComputedStyle(p), frame = inside(p);
      if (p === document.body || p === document.documentElement) break;
      if (p !== el || kind === "text") {
        const cutX = /hidden|clip/.test(style.overflowX), cutY = /hidden|clip/.test(style.overflowY);
        const outX = reach.l < frame.l - SLACK || reach.r > frame.r + SLACK;
        const outY = reach.t < frame.t - SLACK || reach.b > frame.b + SLACK;
        if (cutX && outX && !(style.textOverflow === "ellipsis" && told)) say(`is cut sideways by ${name(p)}: ${name(el)}`);
        if (cutY && outY && p.localName !== "button") say(`is cut by ${name(p)}: ${name(el)}`);
        if (/auto|scroll/.test(style.overflowX) && p.scrollWidth > p.clientWidth + SLACK) {
          if (!p.classList.contains("wide")) say(`is wider than its place, which scrolls sideways: ${name(p)}`);
          reach = cap(reach, frame);
        }
        if (cutX) reach = { ...reach, l: Math.max(reach.l, frame.l), r: Math.min(reach.r, frame.r) };
        if (/auto|scroll/.test(style.overflowY) && p.scrollHeight > p.clientHeight + SLACK) {
          if (p.clientHeight < LEAST_SCROLLED) say(`is scrolled through a slit of ${p.clientHeight} px: ${name(p)}`);
          one.scroller = one.scroller || p;
          reach = cap(reach, frame);
        }
      }
      if (style.position === "fixed" || p.localName === "dialog") { isFixed = true; break; }
    }
    one.seen = cap(reach, reach);
    if (!hasArea(one.seen)) continue;  // scrolled out of its place
    const down = isFixed || !pageScrolls;
    const y = down ? 0 : scrollY;
    if (one.seen.l < -SLACK || one.seen.r > W + SLACK || one.seen.t + y < -SLACK || (down && one.seen.b > H + SLACK))
      say(`lies outside the window: ${name(el)}`);
  }
  if (document.documentElement.scrollWidth > W + SLACK) say(`the page scrolls sideways: ${document.documentElement.scrollWidth} > ${W}`);

  // -- nothing over another
  const clear = things.filter((one) => hasArea(one.seen)).sort((a, b) => a.box.t - b.box.t);
  const isSticky = (el) => above(el).some((p) => getComputedStyle(p).position === "sticky");
  clear.forEach((one, k) => {
    for (const other of clear.slice(k + 1)) {
      const same = one.scroller && one.scroller === other.scroller, [a, b] = same ? [one.box, other.box] : [one.seen, other.seen];
      if (same && b.t > a.b) break;
      const both = cap(a, b);
      if (both.r - both.l > SLACK && both.b - both.t > SLACK && one.el !== other.el && !related(one.el, other.el)
          && !(isSticky(one.el) || isSticky(other.el)))
        say(`lies over another: ${name(one.el)} and ${name(other.el)}`);
    }
    const x = (one.seen.l + one.seen.r) / 2, y = (one.seen.t + one.seen.b) / 2;
    if (x < 0 || x >= W || y < 0 || y >= H) return;
    let hit = document.elementFromPoint(x, y);
    while (hit && hit.shadowRoot && hit.shadowRoot.elementFromPoint(x, y) && hit.shadowRoot.elementFromPoint(x, y) !== hit)
      hit = hit.shadowRoot.elementFromPoint(x, y);
    if (hit && !related(hit, one.el) && !isSticky(hit)) say(`is covered by ${name(hit)}: ${name(one.el)}`);
  });

  // -- text can be told from its ground
  const parse = (colour) => { const n = (colour.match(/[\d.]+/g) || []).map(Number);
    return colour.startsWith("color(srgb") ? [...n.slice(0, 3).map((c) => 255 * c), n[3] ?? 1] : [n[0], n[1], n[2], n[3] ?? 1]; };
  const mix = (over, under) => [0, 1, 2].map((k) => over[k] * over[3] + under[k] * (1 - over[3]));
  const light = (c) => c.map((v) => v / 255).map((v) => v <= 0.03928 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4)
    .reduce((sum, v, k) => sum + v * [0.2126, 0.7152, 0.0722][k], 0);
  const contrast = (a, b) => { const [x, y] = [light(a), light(b)].sort((p, q) => q - p); return (x + 0.05) / (y + 0.05); };
  const groundOf = (el) => above(el).reverse().reduce((under, p) => mix(parse(getComputedStyle(p).backgroundColor), under), [255, 255, 255]);
  for (const one of new Map(clear.filter((t) => t.kind === "text").map((t) => [t.el, t])).values()) {
    if (above(one.el).some((p) => p.disabled)) continue;
    if (one.el.closest(".stale svg")) continue;  // a picture of what was: dim on purpose
    const style = getComputedStyle(one.el), isDrawn = one.el.namespaceURI.endsWith("svg");
    const ink = parse(isDrawn ? style.fill : style.color), ground = groundOf(one.el);
    ink[3] *= above(one.el).reduce((all, p) => all * Number(getComputedStyle(p).opacity), 1);
    if (one.el.matches(".bars .in")) continue;  // its ground is the bar beside it
    const ratio = contrast(mix(ink, ground), ground);
    const least = /[\p{L}\p{N}]/u.test(one.el.textContent) ? LEAST_CONTRAST : 3;  // a sample of a colour
    if (ratio < least) say(`is pale (contrast ${ratio.toFixed(1)}): ${name(one.el)}`);
  }

  // -- plots: room for what is drawn, titles and labels whole and told from the ground
  const pen = document.createElement("canvas").getContext("2d");
  const wide = (words, font) => { pen.font = font; return Math.max(...String(words).split("\n").map((l) => pen.measureText(l).width)); };
  const views = (some) => some.flatMap((v) => [v, ...views([...(v.child_views || [])])]);
  const roots = window.Bokeh ? [...(Bokeh.index.roots || Object.values(Bokeh.index))] : [];
  for (const view of new Set(views(roots).filter((v) => v.model && v.model.type === "Figure"))) {
    if (!view.el.checkVisibility() || !top.contains(above(view.el).find((p) => p.isConnected && p.getRootNode() === document))) continue;
    const { model, frame } = view, own = view.el.getBoundingClientRect(), title = model.title;
    const words = title ? String(title.text).trim() : "", what = `plot "${words || model.yaxis?.[0]?.axis_label || ""}"`;
    const plain = (label, size, face, style) => `${style === "bold" ? "bold " : ""}${size} ${face}`;
    if (frame.bbox.width < 120 || frame.bbox.height < 36)
      say(`has no room: ${what}, ${Math.round(frame.bbox.width)} x ${Math.round(frame.bbox.height)} px`);
    if (words && title.visible) {
      const w = wide(title.text, plain(0, title.text_font_size, title.text_font, title.text_font_style));
      const high = [...view.renderer_views].find(([m]) => m === title)?.[1].layout?.bbox.height ?? 0;
      const lines = String(title.text).split("\n").length, needed = lines * parseFloat(title.text_font_size);
      if (high < needed) say(`is cut: ${lines} lines of the title of ${what}, ${Math.round(high)} of ${Math.round(needed)} px`);
      if (frame.bbox.left + w > own.width + SLACK) say(`is cut: title of ${what}, ${Math.round(w)} of ${Math.round(own.width - frame.bbox.left)} px`);
    }
    const ground = groundOf(view.el);
    const ink = (colour, part) => { pen.fillStyle = "#888"; pen.fillStyle = colour; const hex = pen.fillStyle;
      const rgb = hex.startsWith("#") ? [1, 3, 5].map((k) => parseInt(hex.slice(k, k + 2), 16)) : parse(hex).slice(0, 3);
      const ratio = contrast(rgb, ground); if (ratio < LEAST_CONTRAST) say(`is pale (contrast ${ratio.toFixed(1)}): ${part} of ${what}`); };
    if (words && title.visible) ink(title.text_color, "title");
    for (const side of ["above", "below", "left", "right"]) for (const axis of model[side]) {
      if (!axis.type.endsWith("Axis") || !axis.visible) continue;
      ink(axis.major_label_text_color, "axis"); ink(axis.axis_label_text_color, "axis");
      if (!axis.axis_label) continue;
      const w = wide(axis.axis_label, plain(0, axis.axis_label_text_font_size, axis.axis_label_text_font));
      const upright = side === "left" || side === "right";
      const middle = upright ? frame.bbox.top + frame.bbox.height / 2 : frame.bbox.left + frame.bbox.width / 2;
      const room = 2 * Math.min(middle, (upright ? own.height : own.width) - middle);
      if (w > room + SLACK) say(`is cut: label "${axis.axis_label}" of ${what}, ${Math.round(w)} of ${Math.round(room)} px`);
    }
    // figures in blocks are no wider than their blocks
    for (const renderer of model.renderers) {
      const glyph = renderer.glyph, data = renderer.data_source?.data;
      if (!glyph || glyph.type !== "Text" || glyph.text_align?.value !== "center" || !data.text || (glyph.text_alpha?.value ?? 1) === 0) continue;
      const across = frame.bbox.width / (model.x_range.end - model.x_range.start), down = frame.bbox.height / (model.y_range.end - model.y_range.start);
      const size = glyph.text_font_size?.value || "9px", w = Math.max(0, ...[...data.text].map((t) => wide(t, `${size} ${glyph.text_font?.value || "helvetica"}`)));
      const upright = Math.abs(glyph.angle?.value || 0) > 1;
      if (w > (upright ? down : across) + SLACK || parseFloat(size) > (upright ? across : down) + SLACK)
        say(`are wider than their blocks: figures of ${what}, ${Math.round(w)} px in ${Math.round(across)} x ${Math.round(down)} px`);
    }
  }

  // -- and there is something
  const main = document.querySelector("main"), place = main && cap(boxOf(main.getBoundingClientRect()), { l: 0, t: 0, r: W, b: H });
  if (top === document.body && (!place || place.b - place.t < 0.4 * H)) say(`the page's own part is ${place ? Math.round(place.b - place.t) : 0} px high`);
  if (top === document.body && main && !clear.some((one) => main.contains(one.el) || above(one.el).includes(main))) say("the page is blank");
  return [...found];
}
