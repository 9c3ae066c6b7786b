"use strict";
// Show what is new, ten times a second. `FACTS` and the figures come from charts.js.
(() => {
  Bokeh.set_log_level("error");  // it warns of each figure without data
  const GIVE_UP_MS = 700, DRAW_MS = 250, GAP_MS = 2000, WATCH_MS = 200, AGAIN_MS = 200, CHANGES = 12, PIXELS = 500, ANSWER_MS = 3000;
  const at = id => document.getElementById(id);
  const dark = matchMedia("(prefers-color-scheme: dark)");
  const SPANS_MS = { "10min": 6e5, "1h": 3.6e6, all: Infinity };
  let span = "10min", key = "", added = 0, width_ms = SPANS_MS[span], paused = false, moving = false;
  let figures, rows, runs, time, answered_ms = performance.now(), drawn_ms = 0;
  // All rows of the span; `rows` holds those drawn.
  let kept = { time_ms: [] }, dropped = 0, extended = 0, every_ms = 100;

  const fixed = (value, digits) => value.toFixed(digits).replace("-", "−");
  const num = (value, digits, unit = "") =>
    typeof value === "number" ? `${fixed(value, digits)}${unit && " " + unit}` : "–";
  const pm = (value, std, digits, unit) =>
    typeof value === "number" ? `${fixed(value, digits)} ± ${num(std, digits)} ${unit}` : "–";
  // A possible current without deviation is the largest that the model's logs had.
  const possible = (a, std) => a && std === 0 ? `at least ${Number(a.toPrecision(3))} A` : pm(a, std, 1, "A");
  const energy = (wh, std) => wh < 1000 ? pm(wh, std, wh < 100 ? 2 : 0, "Wh") : pm(scaled(wh, 1e-3), scaled(std, 1e-3), 2, "kWh");
  const scaled = (value, factor) => (typeof value === "number" ? value * factor : null);
  const words = bits => Object.entries(FACTS.reasons).filter(([bit]) => bits & bit).map(([, text]) => text);
  // bokeh's axes show UTC: local time is drawn by moving the stamps.
  const SHIFT_MS = -6e4 * new Date().getTimezoneOffset();
  const clock = ms => new Date(ms).toISOString().slice(11, 19);
  const put = (element, text) => {
    if (element.firstChild === null) element.textContent = text;
    else if (element.firstChild.data !== text) element.firstChild.data = text;
  };

  // Means of the last second: shown once a second.
  let means = {}, means_ms = -Infinity;
  function meanTiles(status, latest) {
    if (performance.now() - means_ms < 1000 && "Frames" in means) return means;
    means_ms = performance.now();
    const counts = Object.values(status.rejects).reduce((sum, count) => sum + count, 0);
    means = {
      "Frames": num(latest.frames_per_s, 0, "/s"),
      "Rejects": `${counts} (${num(latest.rejects_per_s, 1, "/s")})`,
      "Latency": num(latest.latency_ms, 2, "ms"),
      "Latency, 99 % below": num(scaled(status.latency.p99_at_most_s, 1e3), 1, "ms"),
    };
    return means;
  }

  function tiles(status, latest) {
    const { estimate, health, power, cells } = status, sample = status.sample ?? {};
    return {
      "SoC by voltage": num(estimate.soc_newton_pct, 2, "%"),
      "SoC by counting": num(estimate.soc_coulomb_pct, 2, "%"),
      "Current": num(sample.current_a, 2, "A"),
      "Voltage": num(sample.voltage_v, 2, "V"),
      "Model voltage": num(estimate.voltage_model_v, 2, "V"),
      "Residual": num(scaled(estimate.residual_v, 1e3), 0, "mV"),
      "Temperature": num(sample.temperature_c, 1, "°C"),
      "Capacity": pm(health?.capacity_ah, health?.capacity_std_ah, 1, "Ah"),
      "Resistance, to model": pm(health?.resistance_ratio, health?.resistance_std, 2, "×"),
      "Current offset": pm(health?.offset_a, health?.offset_std_a, 2, "A"),
      "Possible discharge, 10 s": possible(power?.discharge_a, power?.discharge_std_a),
      "Possible charge, 10 s": possible(power?.charge_a, power?.charge_std_a),
      "Energy left": energy(power?.energy_wh, power?.energy_std_wh),
      ...(cells ? {
        "Weakest cell": cells.weakest === null ? "not distinguishable" : `number ${cells.weakest} of ${cells.cells}`,
        "SoC of that cell": pm(cells.soc_pct, cells.soc_std_pct, 1, "%"),
      } : {}),
      ...meanTiles(status, latest),
    };
  }

  function show(status, latest) {
    put(at("place"), `${status.vehicle} on ${status.bus}`);
    const { soc_pct, soc_std_pct } = status.estimate;
    put(at("soc"), soc_pct === null ? "not known yet" : pm(soc_pct, soc_std_pct, 2, "%"));
    put(at("state"), status.status);
    at("state").dataset.status = status.status;
    put(at("reasons"), words(latest.reasons).join("; "));
    showRecording(status.record);
    put(at("command"), `cangauge gap cangauge-last-hour.csv -m '${status.model.replaceAll("'", "'\\''")}'`);
    const wanted = Object.entries(tiles(status, latest)), list = at("tiles");
    if (list.children.length !== wanted.length) {
      list.replaceChildren(...wanted.map(([name]) => {
        const tile = document.createElement("div");
        tile.append(document.createElement("dt"), document.createElement("dd"));
        tile.firstChild.textContent = name;
        return tile;
      }));
    }
    wanted.forEach(([name, text], index) => {
      put(list.children[index].firstChild, name);
      put(list.children[index].lastChild, text);
    });
  }

  function showRecording(record) {
    if (!record) { put(at("recording"), ""); return; }
    const bytes = record.written_bytes, size = bytes < 1e6 ? num(bytes / 1e3, 0, "kB") : num(bytes / 1e6, 1, "MB");
    const lost = record.lost_frames ? `, ${record.lost_frames} frames lost` : "";
    put(at("recording"), `Recording to ${record.path}: ${size}${lost}. ${record.problem ?? ""}`);
  }

  function trouble(texts) {
    // The seconds in a text change all the time: read aloud once only.
    put(at("troubles"), texts.join(" "));
    document.querySelector("main").classList.toggle("old", texts.length > 0);
  }

  // Stretches of one status and reasons, and the list of the latest changes.
  function extend(fresh) {
    const start = Math.max(extended - dropped, 0), times = kept.time_ms.slice(start);
    extended = dropped + kept.time_ms.length;
    const found = fresh ? [] : runs.data.left.map((_, index) =>
      Object.fromEntries(Object.entries(runs.data).map(([name, values]) => [name, values[index]])));
    times.forEach((ms, index) => {
      const status = FACTS.statuses[kept.status[start + index]], text = words(kept.reasons[start + index]).join("; ") || "no reason";
      const last = found.at(-1);
      const isNext = last && ms - last.right <= gap_ms();
      if (isNext) last.right = ms;
      if (isNext && last.status === status && last.words === text) return;
      found.push({ left: ms, right: ms, status, colour: FACTS.colours[status], words: text });
    });
    const shown = found.filter(run => !kept.time_ms.length || run.right >= kept.time_ms[0]).slice(-2000);
    const isLonger = shown.length !== runs.data.left.length || fresh;
    runs.data = Object.fromEntries(["left", "right", "status", "colour", "words"].map(name => [name, shown.map(run => run[name])]));
    if (!isLonger) return;
    at("changes").replaceChildren(...shown.slice(-CHANGES).reverse().map(run => {
      const item = document.createElement("li");
      item.textContent = `${clock(run.left)} ${run.status}` + (run.words === "no reason" ? "" : `: ${run.words}`);
      return item;
    }));
  }

  // Longest time between rows of which none is missing.
  const gap_ms = () => Math.max(5 * every_ms, GAP_MS);

  // Break the lines where rows are missing: a service that was stopped, for instance.
  function broken(data, limit_ms) {
    const times = data.time_ms;
    for (let row = times.length - 1; row > 0; row -= 1) {
      if (!(times[row] - times[row - 1] > limit_ms)) continue;
      for (const values of Object.values(data)) values.splice(row, 0, values === times ? times[row - 1] : NaN);
    }
    return data;
  }

  function setRange(start, end) {
    moving = true;
    time.setv({ start, end });
    moving = false;
  }

  function follow() {
    const times = kept.time_ms;
    if (!times.length || paused) return;
    const end = times.at(-1), first = times[0];
    setRange(Math.max(end - width_ms, Math.min(first, end - 1e4)), end);
  }

  // Draw the rows between the ends of the time axis: all, or the least and largest of a pixel's stretch.
  function draw() {
    const times = kept.time_ms, first = Math.max(times.findIndex(ms => ms >= time.start) - 1, 0);
    const after = times.findLastIndex(ms => ms <= time.end) + 2, every = Math.ceil((after - first) / PIXELS);
    const cut = values => values.slice(first, after);
    const columns = of => Object.fromEntries(Object.entries(kept).map(([name, values]) => [name, of(values, name)]));
    if (every <= 2) { rows.data = broken(columns(cut), gap_ms()); return; }
    // Stretches begin at the same rows in each picture, so that it stands still.
    const starts = [];
    for (let row = first - (first + dropped) % every; row < Math.min(after, times.length); row += every) starts.push(Math.max(row, 0));
    const ends = [...starts.slice(1), Math.min(after, times.length)];
    rows.data = broken(columns((values, name) => starts.flatMap((start, index) =>
      name === "time_ms" ? [values[start], values[ends[index] - 1]] : extremes(values, start, ends[index]))),
    every * every_ms + gap_ms());
  }

  // The least and the largest value, in the order of their rows.
  function extremes(values, start, end) {
    let low = start, high = start;
    for (let row = start; row < end; row += 1) {
      if (!(values[row] >= values[low])) { if (!Number.isNaN(values[row])) low = row; }
      if (!(values[row] <= values[high])) { if (!Number.isNaN(values[row])) high = row; }
    }
    return [values[Math.min(low, high)], values[Math.max(low, high)]];
  }

  function take(answer) {
    const columns = answer.columns;
    for (const values of Object.values(columns)) {
      values.forEach((value, index) => { if (value === null) values[index] = NaN; });
    }
    columns.time_ms = columns.time_ms.map(ms => ms + SHIFT_MS);
    const fresh = (answer.key !== key || !answer.is_known) && !isContinued(answer);
    if (fresh) [kept, dropped, extended] = [columns, 0, 0];
    else for (const [name, values] of Object.entries(columns)) kept[name].push(...values);
    const excess = Math.max(kept.time_ms.length - FACTS.rows_at_most[span], 0);
    dropped += excess;
    for (const values of Object.values(kept)) values.splice(0, excess);
    ({ key, added, every_ms } = answer);
    // The figures are drawn again once the picture has moved by about two pixels, at most four times a second; the
    // tiles each time.
    const isDue = performance.now() - drawn_ms >= Math.max((time.end - time.start) / PIXELS, DRAW_MS);
    if (fresh || (isDue && columns.time_ms.length)) redraw(fresh);
  }

  // After a restart of the service its rows go on from those already shown.
  function isContinued(answer) {
    const times = kept.time_ms;
    return key !== "" && key.split("-")[0] !== answer.key.split("-")[0] && times.length > 0 && !(answer.columns.time_ms[0] <= times.at(-1));
  }

  function redraw(fresh) {
    drawn_ms = performance.now();
    extend(fresh);
    follow();
    draw();
  }

  // What is new comes by a socket, from each question on: which rows this page has, or that it wants none.
  let socket = null;
  function question() {
    if (socket?.readyState === WebSocket.OPEN) socket.send(JSON.stringify(paused ? {} : { span, key, after: added }));
  }

  function hear(content) {
    answered_ms = performance.now();
    if (content.columns && content.span === span && !paused) take(content);
    if (content.status) show(content.status, content.latest);
    trouble(content.troubles);
  }

  function connect() {
    if (socket || document.hidden) return;
    const own = socket = new WebSocket(`${location.origin.replace("http", "ws")}/stream`);
    own.onopen = question;
    own.onmessage = event => hear(JSON.parse(event.data));
    own.onclose = async () => {
      if (socket === own) socket = null;
      if (document.hidden) return;
      const answer = await fetch("/rows").catch(() => null);
      if (answer?.status === 401) location.assign("/enter");
      else setTimeout(connect, AGAIN_MS);
    };
  }

  function watch() {
    const seconds = (performance.now() - answered_ms) / 1e3;
    if (document.hidden || 1e3 * seconds <= GIVE_UP_MS) return;
    trouble([`The service does not answer for ${seconds.toFixed(0)} s. The values are old.`]);
    if (1e3 * seconds > ANSWER_MS && socket) { const old = socket; socket = null; old.close(); }
  }

  function paint() {
    const ink = dark.matches ? "#d5dce6" : "#333d4a", line = dark.matches ? "#333d49" : "#dfe4ea";
    const blue = dark.matches ? "#56b4e9" : "#0072b2";
    for (const figure of figures) {
      for (const part of [...figure.above, ...figure.below, ...figure.left, ...figure.center]) {
        if (part.type.endsWith("Axis")) part.setv({ major_label_text_color: ink, axis_line_color: ink, major_tick_line_color: ink });
        if (part.type === "Grid") part.setv({ grid_line_color: line });
        if (part.type === "Legend") part.setv({ label_text_color: ink });
      }
      figure.outline_line_color = line;
      for (const { glyph } of figure.renderers) {
        if (["#0072b2", "#56b4e9"].includes(glyph.line_color?.value)) glyph.line_color = { value: blue };
      }
    }
  }

  function setPaused(wanted) {
    paused = wanted;
    at("pause").setAttribute("aria-pressed", String(paused));
    put(at("pause"), paused ? "Resume" : "Pause");
    question();
    if (!paused) { width_ms = SPANS_MS[span]; follow(); draw(); }
  }

  function move(scale, shift) {
    const width = time.end - time.start, end = time.end + shift * width;
    setPaused(true);
    const middle = end - width / 2;
    setRange(middle - scale * width / 2, middle + scale * width / 2);
    draw();
  }

  function choose(tab) {
    for (const each of document.querySelectorAll("[role=tab]")) {
      const chosen = each === tab;
      each.setAttribute("aria-selected", String(chosen));
      each.tabIndex = chosen ? 0 : -1;
      at(each.getAttribute("aria-controls")).hidden = !chosen;
    }
    tab.focus();
  }

  function controls() {
    for (const radio of document.querySelectorAll("[name=span]")) {
      radio.addEventListener("change", () => { span = radio.value; key = ""; added = 0; setPaused(false); });
    }
    at("pause").addEventListener("click", () => setPaused(!paused));
    at("in").addEventListener("click", () => move(0.5, 0));
    at("out").addEventListener("click", () => move(2, 0));
    at("back").addEventListener("click", () => move(1, -0.5));
    at("forth").addEventListener("click", () => move(1, 0.5));
    const tabs = [...document.querySelectorAll("[role=tab]")];
    tabs.forEach((tab, index) => {
      tab.addEventListener("click", () => choose(tab));
      tab.addEventListener("keydown", event => {
        if (event.key === "ArrowRight" || event.key === "ArrowLeft") choose(tabs[1 - index]);
      });
    });
    at("copy").addEventListener("click", async () => {
      try { await navigator.clipboard.writeText(at("command").textContent); put(at("copied"), "Copied."); }
      catch { put(at("copied"), "The browser refuses: select the command and copy it."); }
    });
    time.change.connect(() => {
      if (moving) return;
      if (!paused) setPaused(true);
      draw();
    });
    dark.addEventListener("change", paint);
  }

  function begin() {
    const drawn = Bokeh.documents[0];
    if (!drawn || !drawn.is_idle) { setTimeout(begin, 30); return; }
    figures = drawn.roots();
    [rows, runs, time] = ["rows", "runs", "time"].map(name => drawn.get_model_by_name(name));
    for (const figure of figures) {
      // A finger scrolls the page; the buttons zoom.
      if (matchMedia("(pointer: coarse)").matches) figure.toolbar.active_drag = null;
      if (matchMedia("(max-width: 600px)").matches) figure.below[0].ticker.desired_num_ticks = 3;
    }
    paint();
    controls();
    // A figure out of sight is not drawn.
    const seen = new IntersectionObserver(entries => {
      for (const { target, isIntersecting } of entries) {
        const view = Bokeh.index.find_one_by_id(figures.find(({ name }) => name === target.dataset.figure).id);
        if (isIntersecting) view.unpause(); else if (!view.is_paused) view.pause();
      }
    });
    for (const section of document.querySelectorAll("[data-figure]")) seen.observe(section);
    connect();
    setInterval(watch, WATCH_MS);
    document.addEventListener("visibilitychange", () => { if (document.hidden) socket?.close(); else connect(); });
  }
  begin();
})();
