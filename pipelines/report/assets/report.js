"use strict";
// Draws the figures of a report with uPlot: drag to zoom, double click for all of it, the legend switches marks.
(() => {
  const COLOURS = ["#0072b2", "#d55e00", "#009e73", "#e69f00", "#cc79a7", "#56b4e9", "#8c8c8c"];
  const figures = JSON.parse(document.getElementById("figures").textContent);
  const variable = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
  const colourOf = (mark, number) => COLOURS[(mark.colour ?? number) % COLOURS.length];
  const faded = (colour, alpha) => colour + Math.round(255 * alpha).toString(16).padStart(2, "0");
  const rises = (x) => x.every((value, i) => i === 0 || (value !== null && x[i - 1] !== null && value > x[i - 1]));
  const written = (value) => value == null ? "–" : String(+value.toPrecision(4)).replace("-", "−");

  const isStrip = (mark) => mark.kind === "strip";
  const isThin = (panel) => panel.marks.every(isStrip);
  const namesOf = (panels) => [...new Set(panels.flatMap((panel) => panel.marks.filter(isStrip)
    .flatMap((mark) => mark.x.map((span) => span[2]))))];

  // what is drawn of one panel: series that uPlot draws itself, and marks that are drawn over its axes; a name of
  // intervals has one colour in a figure, and panels of nothing else all have the same names: one legend serves them
  function taken(panel, figure, thin) {
    const names = namesOf(figure.panels), shared = thin ? namesOf(figure.panels.filter(isThin)) : [];
    const own = [], drawn = [];
    let number = 0;
    for (const mark of panel.marks) {
      if (isStrip(mark)) {
        names.forEach((name, i) => {
          const spans = mark.x.filter((span) => span[2] === name);
          if (spans.length || shared.includes(name)) drawn.push({ kind: "strip", label: name, colour: thin ? i : COLOURS.length - 1 - i % COLOURS.length, number: i, x: spans, thin });
        });
        continue;
      }
      const entry = { ...mark, number: number++ };
      const plain = (mark.kind === "line" || (mark.kind === "points" && !mark.low)) && rises(mark.x);
      (plain ? own : drawn).push(entry);
    }
    return { own, drawn };
  }

  function extent(lists, margin) {
    let low = Infinity, high = -Infinity;
    for (const list of lists) for (const value of list || []) if (value !== null && value !== undefined) {
      low = Math.min(low, value); high = Math.max(high, value);
    }
    if (low > high) return [0, 1];
    const pad = low === high ? (Math.abs(low) || 1) * 0.1 : (high - low) * margin;
    return [low - pad, high + pad];
  }

  function ranges(panel, categories) {
    const flat = panel.marks;
    if (categories)
      return { x: panel.x_range || extent([[0], ...flat.flatMap((m) => [m.y, m.low, m.high])], 0.03),
        y: [-0.6, categories.length - 0.4] };
    const x = flat.flatMap((m) => isStrip(m) ? [m.x.flatMap((s) => [s[0], s[1]])] : [m.x]);
    const y = flat.flatMap((m) => isStrip(m) ? [] : [m.y, m.low, m.high]);
    return { x: panel.x_range || extent(x, panel.equal ? 0.04 : flat.some((m) => m.kind === "points") ? 0.02 : 0), y: panel.y_range || extent(y, 0.05) };
  }

  function drawMark(u, mark, vertical) {
    const { ctx } = u, colour = colourOf(mark, mark.number), dpr = devicePixelRatio || 1;
    const px = (value) => u.valToPos(value, "x", true), py = (value) => u.valToPos(value, "y", true);
    ctx.strokeStyle = colour; ctx.lineWidth = 1.3 * dpr; ctx.setLineDash([]);
    if (isStrip(mark)) {
      ctx.fillStyle = faded(colour, mark.thin ? 0.75 : 0.18);
      for (const [start, end] of mark.x) ctx.fillRect(px(start), u.bbox.top, px(end) - px(start), u.bbox.height);
    } else if (mark.kind === "band") {
      ctx.fillStyle = faded(colour, 0.22);
      let i = 0;
      const known = (k) => mark.low[k] !== null && mark.high[k] !== null && mark.x[k] !== null;
      while (i < mark.x.length) {
        if (!known(i)) { i++; continue; }
        let j = i;
        while (j < mark.x.length && known(j)) j++;
        ctx.beginPath();
        for (let k = i; k < j; k++) ctx.lineTo(px(mark.x[k]), py(mark.high[k]));
        for (let k = j - 1; k >= i; k--) ctx.lineTo(px(mark.x[k]), py(mark.low[k]));
        ctx.fill();
        i = j;
      }
    } else if (mark.kind === "line") {
      if (mark.dashed) ctx.setLineDash([6 * dpr, 4 * dpr]);
      ctx.beginPath();
      let gap = true;
      mark.x.forEach((x, i) => {
        if (x === null || mark.y[i] === null) { gap = true; return; }
        ctx[gap ? "moveTo" : "lineTo"](px(x), py(mark.y[i]));
        gap = false;
      });
      ctx.stroke(); ctx.setLineDash([]);
    } else if (mark.kind === "points") {
      ctx.fillStyle = colour;
      mark.x.forEach((x, i) => {
        if (x === null || mark.y[i] === null) return;
        ctx.beginPath(); ctx.arc(px(x), py(mark.y[i]), 3 * dpr, 0, 2 * Math.PI); ctx.fill();
        if (mark.low && mark.low[i] !== null) {
          ctx.beginPath(); ctx.moveTo(px(x), py(mark.low[i])); ctx.lineTo(px(x), py(mark.high[i])); ctx.stroke();
        }
      });
    } else if (mark.kind === "bars") {
      const height = Math.abs(py(1) - py(0)) * 0.8 / vertical.count, start = px(Math.max(0, u.scales.x.min));
      mark.y.forEach((value, i) => {
        if (value === null) return;
        const y = py(i) + (vertical.order.get(mark) - 0.5 * (vertical.count - 1)) * height;
        ctx.fillStyle = faded(colour, 0.85);
        ctx.fillRect(start, y - 0.45 * height, px(value) - start, 0.9 * height);
        if (mark.low && mark.low[i] !== null) {
          ctx.strokeStyle = variable("--ink");
          ctx.beginPath(); ctx.moveTo(px(mark.low[i]), y); ctx.lineTo(px(mark.high[i]), y); ctx.stroke();
        }
      });
    }
  }

  function plot(holder, figure, panel, group, last) {
    const thin = isThin(panel), { own, drawn } = taken(panel, figure, thin), bars = drawn.filter((mark) => mark.kind === "bars");
    const categories = bars.length ? bars[0].x : null, width = holder.clientWidth;
    const first = holder.closest(".answer"), label = panel.y_label || undefined;  // its label above: it is low
    const vertical = { count: bars.length, order: new Map(bars.map((mark, i) => [mark, i])) };
    const height = categories ? 46 + Math.max(1, 0.7 * bars.length) * 24 * categories.length
      : panel.equal ? Math.min(460, width) : thin ? 58 + (panel.x_label || (last && figure.x_label) ? 18 : 0) : first ? 190 : 230;
    const full = ranges(panel, categories), zoom = group.zoom, zoomY = { y: null };
    if (panel.equal) {
      const per = Math.max((full.x[1] - full.x[0]) / (width - 70), (full.y[1] - full.y[0]) / (height - 50));
      for (const [key, size] of [["x", width - 70], ["y", height - 50]]) {
        const middle = (full[key][0] + full[key][1]) / 2;
        full[key] = [middle - per * size / 2, middle + per * size / 2];
      }
    }
    const tables = own.map((mark) => [mark.x, mark.y]);
    const data = tables.length ? uPlot.join(tables, tables.map(() => [1])) : [[full.x[0], full.x[1]]];
    for (const _ of drawn) data.push(data[0].map(() => null));
    const shown = (u, v) => v == null ? "" : written(v);
    const series = [{ label: panel.x_label || figure.x_label || "x", value: shown }];
    for (const mark of own) {
      const colour = colourOf(mark, mark.number), line = mark.kind === "line";
      series.push({ label: mark.label || " ", stroke: colour, width: line ? 1.4 : 0, dash: mark.dashed ? [6, 4] : undefined,
        points: { show: !line, size: 6, fill: colour }, paths: line ? undefined : () => null, value: shown });
    }
    for (const mark of drawn)
      series.push({ label: mark.label || " ", stroke: colourOf(mark, mark.number), width: 8, points: { show: false }, value: () => "" });
    const ink = variable("--ink"), grid = { stroke: variable("--rule"), width: 1 }, font = "12px system-ui, sans-serif";
    const counts = panel.marks.every((mark) => isStrip(mark) || mark.x.every((x) => x === null || Number.isInteger(x)));
    const longest = categories ? Math.max(...categories.map(widthOf)) : 0;
    const axes = [
      { stroke: ink, grid, ticks: grid, font, labelFont: font, labelSize: 18, size: 34, label: panel.x_label || (last ? figure.x_label : "") || undefined,
        values: (u, splits) => splits.map(written), ...(counts ? { incrs: [1, 2, 5, 10, 20, 50, 100, 200, 500, 1000] } : {}) },
      { stroke: ink, grid: categories ? { show: false } : grid, ticks: grid, font, labelFont: font, labelSize: 18,
        size: categories ? Math.min(width * 0.42, 22 + longest) : (u, values) => Math.max(54, 18 + Math.max(0, ...(values || []).map(widthOf))), label: first ? undefined : label,
        values: (u, splits) => categories ? splits.map((i) => shortened(categories[i] ?? "", width * 0.42)) : splits.map(written) },
    ];
    axes[1].show = !thin;
    if (categories) axes[1].splits = () => categories.map((_, i) => i);
    if (panel.log_x) Object.assign(axes[0], { splits: (u, axis, low, high) => decades(low, high),
      values: (u, splits) => splits.map(written), filter: (u, splits) => splits });
    const u = new uPlot({
      width, height, series, axes, title: panel.title || ((thin || first) && label) || undefined,
      legend: { show: thin ? last : series.length > 2 || !panel.y_label, live: !categories && !thin && !first },
      cursor: { sync: { key: group.key }, drag: { x: true, y: !categories, uni: 40, setScale: false },
        bind: { dblclick: () => () => { zoom.x = null; zoomY.y = null; group.redraw(); return null; } } },
      scales: {
        x: { time: false, distr: panel.log_x ? 3 : 1, range: () => (!categories && !panel.equal && zoom.x) || (categories || panel.equal ? zoomY.x : null) || full.x },
        y: { dir: categories ? -1 : 1, range: () => zoomY.y || full.y },
      },
      hooks: {
        setSelect: [(u) => {
          const { left, top, width, height } = u.select;
          if (width < 6 && height < 6) return;
          const x = [u.posToVal(left, "x"), u.posToVal(left + width, "x")];
          if (width >= 6) { if (categories || panel.equal) zoomY.x = x; else zoom.x = x; }
          if (!categories && height >= 6 && height < u.over.clientHeight - 2)
            zoomY.y = [u.posToVal(top + height, "y"), u.posToVal(top, "y")];
          u.setSelect({ left: 0, top: 0, width: 0, height: 0 }, false);
          group.redraw();
        }],
        setSeries: [(u, i, { show }) => {
          if (thin && show !== undefined) for (const other of group.plots)
            if (other.thin && other !== u && other.series[i].show !== show) other.setSeries(i, { show });
        }],
        draw: [(u) => {
          u.ctx.save();
          u.ctx.beginPath(); u.ctx.rect(u.bbox.left, u.bbox.top, u.bbox.width, u.bbox.height); u.ctx.clip();
          drawn.forEach((mark, i) => { if (u.series[own.length + 1 + i].show) drawMark(u, mark, vertical); });
          u.ctx.restore();
        }],
      },
    }, data, holder);
    for (const row of holder.querySelectorAll(".u-legend .u-series"))
      if (!row.textContent.replace(/[^\p{L}\p{N}]/gu, "")) row.hidden = true;  // a mark without a name
    u.thin = thin;
    u.reset = () => { zoomY.x = null; };
    u.rescale = () => { u.setScale("x", { min: full.x[0], max: full.x[1] }); u.setScale("y", { min: full.y[0], max: full.y[1] }); };
    return u;
  }

  const ruler = document.createElement("canvas").getContext("2d");
  ruler.font = "12px system-ui, sans-serif";
  const widthOf = (text) => ruler.measureText(text).width;
  // uPlot's own ticks of a logarithmic axis need one that begins at a power of ten
  function decades(low, high) {
    const found = [];
    for (let power = Math.floor(Math.log10(low)); power <= Math.log10(high); power++)
      for (const first of [1, 2, 5]) found.push(+`${first}e${power}`);
    return found.filter((value) => value >= low && value <= high);
  }

  const shortened = (name, room) => {
    if (widthOf(name) + 20 <= room) return name;
    const most = Math.max(6, Math.floor((room - 20) * name.length / widthOf(name)));
    return name.length <= most ? name : name.slice(0, Math.ceil(most / 2) - 1) + "…" + name.slice(-Math.floor(most / 2));
  };

  function draw(holder) {
    const figure = figures[+holder.dataset.figure];
    holder.replaceChildren();
    const group = { key: "figure" + holder.dataset.figure, zoom: { x: null }, plots: [] };
    group.redraw = () => { for (const u of group.plots) { if (!group.zoom.x) u.reset(); u.rescale(); } };
    figure.panels.forEach((panel, i) => {
      const box = document.createElement("div");
      holder.append(box);
      group.plots.push(plot(box, figure, panel, group, i === figure.panels.length - 1));
    });
    holder.dataset.width = holder.clientWidth;
  }
  function drawVisible() {
    for (const holder of document.querySelectorAll(".plot"))
      if (!holder.closest("details:not([open])") && holder.clientWidth > 0 && holder.dataset.width !== String(holder.clientWidth)) draw(holder);
  }
  let waiting = 0;
  addEventListener("resize", () => { clearTimeout(waiting); waiting = setTimeout(drawVisible, 150); });
  for (const folded of document.querySelectorAll("details")) folded.addEventListener("toggle", drawVisible);
  drawVisible();
})();
