"use strict";
// The newest step of one robot, ten times a second; all that is drawn is kept here and nowhere else.
(() => {
  const HISTORY_S = 300, PLOT_S = 60, STALE_MS = 1500, PERIOD_MS = 100, INTERVAL = 1.96;
  const COLOURS = ["#2f7ed8", "#e07a1f", "#2c9c5a", "#b5489c", "#8a6d3b", "#5ab4c9", "#d0433f", "#7a7f2a", "#6b63c4", "#c98f00", "#3f8f8a", "#9a5a44"];
  const BAD = ["lost", "frozen", "stepped", "disagrees", "gated"], DOUBTFUL = ["late", "reopened", "not finite"];
  const byId = (id) => document.getElementById(id);
  const state = { session: "", token: sessionStorage.getItem("token") || "", wheels: null, name: null, heard: 0, stepped: 0, retry: 500, terrains: [], number: -1 };
  const history = { t: [], terrain: [], probability: [] };
  let plots = { slip: [], current: null }, series = null;

  const text = (id, value) => { const node = byId(id); if (node.textContent !== value) node.textContent = value; };
  const fixed = (value, digits, unit = "") => value === null || value === undefined ? "unknown" : value.toFixed(digits).replace(/^-(?=[0.]*$)/, "").replace("-", "\u2212") + unit;
  const signed = (value, digits) => value === null || value === undefined ? "unknown" : (value < 0 ? "\u2212" : "+") + Math.abs(value).toFixed(digits);
  const degrees = (rad) => rad === null ? null : rad * 180 / Math.PI;
  const colourOf = (terrain) => {
    if (!terrain) return getComputedStyle(document.documentElement).getPropertyValue("--line").trim();
    if (!state.terrains.includes(terrain)) state.terrains.push(terrain);
    return COLOURS[state.terrains.indexOf(terrain) % COLOURS.length];
  };
  const variable = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

  // --- connection -------------------------------------------------------------------------------------
  async function ask() {
    const headers = state.token ? { Authorization: "Bearer " + state.token } : {};
    let message;
    try {
      const answer = await fetch("state?session=" + encodeURIComponent(state.session), { headers, signal: AbortSignal.timeout(5000) });
      if (answer.status === 401) { askToken(); return; }
      if (!answer.ok) throw new Error(answer.status);
      message = await answer.json();
    } catch {
      document.body.classList.add("stale");
      setConnection("lost", "not connected, trying again");
      setTimeout(ask, state.retry);
      state.retry = Math.min(state.retry * 2, 5000);
      return;
    }
    setTimeout(ask, PERIOD_MS);
    take(message);
  }
  function setConnection(kind, words) {
    byId("connection").dataset.state = kind;
    text("connection", words);
  }
  function askToken() {
    sessionStorage.removeItem("token");
    text("token-error", state.token ? "That is not the token." : "");
    byId("token-form").hidden = false;
    byId("token").focus();
    setConnection("waiting", "a token is required");
  }
  function take(message) {
    byId("token-form").hidden = true;
    state.retry = 500;
    state.heard = performance.now();
    show(message);
  }
  setInterval(() => {
    const now = performance.now(), silent = now - state.heard > STALE_MS;
    if (!state.heard || !byId("token-form").hidden) return;
    if (silent) setConnection("lost", "nothing heard for " + Math.round((now - state.heard) / 1000) + " s");
    else if (state.present && now - state.stepped > STALE_MS)
      setConnection("lost", "no step of this robot for " + Math.round((now - state.stepped) / 1000) + " s");
    else return;
    document.body.classList.add("stale");
  }, 500);

  // --- what is shown ----------------------------------------------------------------------------------
  function show(message) {
    showSessions(message);
    text("model", (message.served.model || "none") + " (number " + message.served.number + ")");
    text("table", message.served.table);
    text("trouble", message.trouble.length ? message.trouble.join("; ") : "none");
    const session = message.session, step = session && session.step;
    state.present = Boolean(step);
    if (!session) {
      if (state.name !== null) document.body.classList.add("stale");
      setConnection("waiting", state.name === null ? "connected, no robot yet" : "connected, no robot any more");
      return;
    }
    if (session.session !== state.name) begin(session);
    if (!step) { setConnection("waiting", "connected, no step yet"); return; }
    if (step.number === state.number) return;
    state.number = step.number;
    state.stepped = performance.now();
    document.body.classList.remove("stale");
    setConnection("live", "live");
    const seen = step.observation;
    showTerrain(step, seen);
    showAnswer(message, seen, step.command);
    showWatch(seen.watch);
    byId("doubtful").hidden = !(seen.doubtful || []).length;
    text("doubtful", "Samples: " + (seen.doubtful || []).join("; "));
    showTarget(seen);
    showCommand(session, step.command);
    showSensors(seen.sensors);
    text("latency", fixed(step.latency_s === null ? null : step.latency_s * 1000, 1, " ms"));
    text("speed", fixed(seen.speed_x_mps, 2, " m/s") + ", " + fixed(degrees(seen.yaw_rate_radps), 1, " deg/s"));
    text("recording", session.recording);
    const dropped = Object.entries(session.dropped).map(([kind, n]) => kind + ": " + n);
    text("dropped", dropped.length ? dropped.join("; ") : "nothing");
    keep(step, seen);
  }
  function showSessions(message) {
    const select = byId("session");
    const names = message.sessions, now = [...select.options].map((option) => option.value);
    if (names.length && names.join("\n") !== now.join("\n")) {
      select.replaceChildren(...names.map((name) => new Option(name, name)));
      select.disabled = false;
    } else if (!names.length && !select.disabled) {
      select.replaceChildren(new Option("none connected", ""));
      select.disabled = true;
    }
    if (message.session && select.value !== message.session.session && document.activeElement !== select) select.value = message.session.session;
  }
  function showWatch(watch) {
    byId("watch").hidden = !watch;
    if (!watch) return;
    const channels = Object.entries(watch.channels).map(([name, status]) => name + " " + status);
    byId("watch").dataset.state = watch.alarms.length ? "alarm" : "";
    text("watch", watch.alarms.length ? "The robot " + watch.alarms.map((alarm) => alarm.text).join("; ")
      : channels.join("; ") + (watch.why ? " (" + watch.why + ")" : ""));
  }
  function showTerrain(step, seen) {
    text("terrain", seen.terrain || "unknown");
    byId("swatch").style.background = colourOf(seen.terrain);
    text("probability", seen.terrain && seen.probability !== null ? Math.round(seen.probability * 100) + " %" : "");
    const window_ = seen.window;
    if (!window_) return;
    text("window", window_.refused ? "last window refused: " + window_.refused
      : "last window " + fixed(window_.start_s, 1) + " to " + fixed(window_.end_s, 1, " s") + ": " + (window_.terrain || "unknown, " + (window_.reason || "unlike every learned terrain"))
        + (window_.supported === false ? ", no training run supports it" : ""));
    const box = byId("classes"), names = Object.keys(window_.probabilities);
    if (box.children.length !== names.length || box.dataset.names !== names.join()) {
      box.dataset.names = names.join();
      box.replaceChildren(...names.map((name) => {
        const row = document.createElement("div");
        row.className = "bar"; row.setAttribute("role", "listitem");
        for (const part of ["name", "track", "number"]) { const node = document.createElement("span"); node.className = part; row.append(node); }
        const fill = document.createElement("div"); fill.className = "fill"; fill.style.background = colourOf(name);
        row.children[1].append(fill); row.children[0].textContent = name; row.children[0].title = name;
        return row;
      }));
    }
    names.forEach((name, i) => {
      const value = window_.probabilities[name], row = box.children[i];
      row.querySelector(".fill").style.width = (value === null ? 0 : value * 100).toFixed(1) + "%";
      row.children[2].textContent = value === null ? "-" : Math.round(value * 100) + " %";
    });
  }
  function showAnswer(message, seen, command) {
    const target = seen.target_slip.traction, sensors = Object.entries(seen.sensors), unsound = {};
    for (const [name, health] of sensors) if (health !== "fresh") (unsound[health] ||= []).push(name.replaceAll("_", " "));
    const groups = Object.entries(unsound).map(([health, names]) => (names.length === sensors.length ? "all sensors" : names.join(", ")) + " " + health);
    const traction = !command || command.status !== "ok" || command.traction === "ok" ? "" : ", slip not controlled (" + command.traction + ")";
    text("answer", [
      target ? "Target slip " + signed(target.slip_ratio, 3) + " in traction" + (target.status === "estimated" ? "" : ", " + target.status) : "No target slip",
      ...(command ? ["command " + command.status + traction] : []),
      ...(groups.length ? groups : ["all sensors fresh"]),
      ...message.trouble.slice(0, 1),
    ].join("; ") + ".");
  }
  function showTarget(seen) {
    text("target-of", "entry of the table: " + seen.target_of);
    rows("target", Object.entries(seen.target_slip).map(([name, target]) => [
      name, signed(target.slip_ratio, 3) + (target.slip_std === null ? "" : " \u00b1 " + target.slip_std.toFixed(3)), target.status]));
  }
  function showCommand(session, command) {
    const status = byId("command-status");
    if (!command) { text("command-status", session.control ? "none yet" : "none asked for"); return; }
    text("command-status", command.status === "ok" ? "ok, traction " + command.traction : command.status);
    status.className = "value small " + (command.status !== "ok" ? "bad" : command.traction === "ok" ? "good" : "doubt");
    rows("command", session.wheels.map((name, i) => [name, fixed(command.wheel_radps[i], 2), fixed(degrees(command.steer_rad[i]), 1)]));
    text("twist", "driven: " + fixed(command.twist[0], 2) + " and " + fixed(command.twist[1], 2, " m/s") + ", " + fixed(degrees(command.twist[2]), 1, " deg/s"));
  }
  function showSensors(sensors) {
    const list = byId("sensors"), names = Object.keys(sensors);
    if (list.dataset.names !== names.join()) {
      list.dataset.names = names.join();
      list.replaceChildren(...names.map((name) => {
        const item = document.createElement("li"), value = document.createElement("b");
        item.append(name.replaceAll("_", " "), value);
        return item;
      }));
    }
    names.forEach((name, i) => {
      const value = list.children[i].lastChild, health = sensors[name];
      if (value.textContent !== health) {
        value.textContent = health;
        value.className = BAD.includes(health) ? "bad" : DOUBTFUL.includes(health) ? "doubt" : "good";
      }
    });
  }
  function rows(id, cells) {
    const body = byId(id).tBodies[0];
    while (body.rows.length > cells.length) body.deleteRow(-1);
    cells.forEach((row, i) => {
      const line = body.rows[i] || body.insertRow();
      row.forEach((value, k) => { const cell = line.cells[k] || line.insertCell(); if (cell.textContent !== value) cell.textContent = value; });
    });
  }

  // --- history ----------------------------------------------------------------------------------------
  function begin(session) {
    state.name = session.session; state.wheels = session.wheels; state.number = -1;
    for (const key of Object.keys(history)) history[key] = [];
    series = { t: [], slip: session.wheels.map(() => ({ low: [], high: [], slip: [] })), target: [], current: [] };
    showSlip(session.wheels.length > 0);
    makePlots();
    byId("classes").replaceChildren();
    text("window", "no window yet");
  }
  function keep(step, seen) {
    const now = Date.now() / 1000;
    history.t.push(now); history.terrain.push(seen.terrain || ""); history.probability.push(seen.probability);
    while (history.t[0] < now - HISTORY_S) for (const key of Object.keys(history)) history[key].shift();
    series.t.push(now);
    series.target.push(seen.target_slip.traction ? seen.target_slip.traction.slip_ratio : null);
    series.slip.forEach((one, i) => {
      const slip = seen.slip_ratio[i] ?? null, std = seen.slip_std[i] ?? null;
      one.slip.push(slip);
      one.low.push(slip === null || std === null ? null : slip - INTERVAL * std);
      one.high.push(slip === null || std === null ? null : slip + INTERVAL * std);
    });
    while (series.current.length < seen.current_a.length) series.current.push(new Array(series.t.length - 1).fill(null));
    seen.current_a.forEach((value, i) => series.current[i].push(value));
    while (series.t[0] < now - PLOT_S) {
      series.t.shift(); series.target.shift(); series.current.forEach((one) => one.shift());
      series.slip.forEach((one) => { one.slip.shift(); one.low.shift(); one.high.shift(); });
    }
    const none = seen.slip_ratio.every((value) => value === null) && !series.slip.some((one) => one.slip.some((value) => value !== null));
    if (none !== byId("slip").hidden) { showSlip(!none); makePlots(); }
    text("slip-none", seen.slip_unknown ? "Slip is not known: " + seen.slip_unknown + "." : "Slip is not known yet.");
    byId("slip-none").hidden = !none && !seen.slip_unknown;
    byId("current").parentElement.hidden = series.current.every((one) => one.every((value) => value === null));
    // of a wheel whose speed is not logged there is no slip beside those of others
    [...byId("slip").children].forEach((figure, i) => { figure.hidden = !none && series.slip[i].slip.every((value) => value === null); });
  }
  function axes() {
    const common = { stroke: variable("--soft"), grid: { stroke: variable("--line"), width: 1 }, ticks: { stroke: variable("--line") } };
    return [{ ...common, space: 70, values: (_, splits) => splits.map((t) => t + " s") }, { ...common, size: 46 }];
  }
  function figureIn(box, title) {
    const figure = document.createElement("figure"), caption = document.createElement("figcaption");
    caption.textContent = title; figure.append(caption); box.append(figure);
    return figure;
  }
  function plotIn(figure, curves, bands, range) {
    const width = Math.max(figure.clientWidth, 200), x = { time: false, range: [-PLOT_S, 0] };
    return new uPlot({ width, height: 170, cursor: { show: false }, legend: { show: false }, scales: { x, y: { range } }, axes: axes(), series: [{}, ...curves], bands }, null, figure);
  }
  function makePlots() {
    plots.slip.forEach((plot) => plot.destroy());
    if (plots.current) plots.current.destroy();
    byId("slip").replaceChildren(); byId("current").replaceChildren();
    const slipRange = (_, low, high) => [Math.min(low ?? 0, -0.05) - 0.02, Math.max(high ?? 0, 0.3) + 0.02];
    const currentRange = (_, low, high) => [Math.min(low ?? 0, 0), Math.max(high ?? 1, 1) * 1.1];
    const figures = state.wheels.map((name) => figureIn(byId("slip"), "wheel " + name));  // all, before one is measured
    plots.slip = state.wheels.map((name, i) => {
      const colour = COLOURS[i % COLOURS.length], edge = { stroke: "transparent", width: 0, points: { show: false } };
      return plotIn(figures[i], [{ ...edge }, { ...edge }, { stroke: colour, width: 2, points: { show: false } }, { stroke: variable("--target"), width: 1.5, dash: [6, 4], points: { show: false } }], [{ series: [2, 1], fill: colour + "33" }], slipRange);
    });
    const title = state.wheels.map((name, i) => "wheel " + name + " " + ["solid", "dashed", "dotted", "dash-dot"][i % 4]).join(", ");
    plots.current = plotIn(figureIn(byId("current"), title || "no wheels described"), state.wheels.map((_, i) => ({ stroke: COLOURS[i % COLOURS.length], width: 2, dash: [[], [8, 4], [2, 3], [8, 3, 2, 3]][i % 4], points: { show: false } })), [], currentRange);
  }
  function showSlip(there) {
    byId("slip").hidden = byId("slip-note").hidden = !there;
    byId("slip-none").hidden = there;
  }
  function draw() {
    requestAnimationFrame(draw);
    if (!series || state.drawn === state.number || document.hidden) return;
    state.drawn = state.number;
    const now = Date.now() / 1000, ago = series.t.map((t) => t - now);
    plots.slip.forEach((plot, i) => plot.setData([ago, series.slip[i].low, series.slip[i].high, series.slip[i].slip, series.target]));
    if (plots.current && series.current.length) plots.current.setData([ago, ...series.current]);
    drawBand();
  }
  function drawBand() {
    const canvas = byId("band"), scale = window.devicePixelRatio || 1, width = canvas.clientWidth, height = canvas.clientHeight, top = height - 34;
    if (canvas.width !== Math.round(width * scale) || canvas.height !== Math.round(height * scale)) { canvas.width = Math.round(width * scale); canvas.height = Math.round(height * scale); }
    const ink = canvas.getContext("2d"), now = Date.now() / 1000;
    ink.setTransform(scale, 0, 0, scale, 0, 0); ink.clearRect(0, 0, width, height);
    const x = (t) => width * (1 - (now - t) / HISTORY_S), n = history.t.length, shares = new Map();
    let from = 0, label = -Infinity;
    ink.font = "12px system-ui, sans-serif"; ink.textBaseline = "middle";
    for (let k = 1; k <= n; k++) {
      if (k < n && history.terrain[k] === history.terrain[from]) continue;
      const end = k < n ? history.t[k] : now, terrain = history.terrain[from];
      shares.set(terrain || "unknown", (shares.get(terrain || "unknown") || 0) + end - history.t[from]);
      ink.fillStyle = colourOf(terrain); ink.fillRect(x(history.t[from]), 0, Math.max(x(end) - x(history.t[from]), 1), top);
      if (terrain && x(end) - x(history.t[from]) > ink.measureText(terrain).width + 8 && x(history.t[from]) > label) {
        ink.fillStyle = "#ffffff"; ink.fillText(terrain, x(history.t[from]) + 4, top / 2); label = x(history.t[from]) + ink.measureText(terrain).width;
      }
      from = k;
    }
    ink.strokeStyle = variable("--line"); ink.strokeRect(0.5, top + 4.5, width - 1, 29);
    ink.strokeStyle = variable("--text"); ink.lineWidth = 1.5; ink.beginPath();
    let drawing = false;
    for (let k = 0; k < n; k++) {
      const value = history.probability[k];
      if (value === null) { drawing = false; continue; }
      const y = height - 1 - 28 * value;
      if (drawing) ink.lineTo(x(history.t[k]), y); else ink.moveTo(x(history.t[k]), y);
      drawing = true;
    }
    ink.stroke();
    const total = [...shares.values()].reduce((sum, value) => sum + value, 0) || 1;
    text("band-text", "Last five minutes, below it the probability from 0 to 1. Shares: " + ([...shares].map(([name, s]) => name + " " + Math.round(100 * s / total) + " %").join(", ") || "none yet"));
  }

  // --- controls ---------------------------------------------------------------------------------------
  byId("session").addEventListener("change", (event) => { state.session = event.target.value; });
  byId("token-form").addEventListener("submit", (event) => {
    event.preventDefault();
    state.token = byId("token").value;
    sessionStorage.setItem("token", state.token);
    byId("token-form").hidden = true;
    ask();
  });
  const dark = () => (document.documentElement.dataset.theme || (matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light")) === "dark";
  const showTheme = () => { byId("theme").setAttribute("aria-pressed", String(dark())); };
  byId("theme").addEventListener("click", () => {
    document.documentElement.dataset.theme = dark() ? "light" : "dark";
    localStorage.setItem("theme", document.documentElement.dataset.theme);
    showTheme();
    if (state.wheels) makePlots();
    state.drawn = -1;
  });
  if (localStorage.getItem("theme")) document.documentElement.dataset.theme = localStorage.getItem("theme");
  showTheme();
  byId("more").addEventListener("toggle", () => { if (state.wheels) makePlots(); state.drawn = -1; });  // what is folded has no width
  let width = innerWidth;
  addEventListener("resize", () => { if (Math.abs(innerWidth - width) > 20 && state.wheels) { width = innerWidth; makePlots(); state.drawn = -1; } });
  ask();
  requestAnimationFrame(draw);
})();
