/* Embeds the figures of the report and of the live page, and follows what the reader chooses; figures.js fills them. */
var EmaPage = (function () {
  "use strict";
  var data = null, documents = {}, playing = false;
  var modelled = EmaNumbers.modelled;
  var chosen = { configuration: 0, output: null, input: null, before: 0, after: 0, mode: null, circle: 0 };

  function byId(id) { return document.getElementById(id); }
  function measured() { return data.measured.configurations; }
  function named(name) { return measured().filter(function (c) { return c.name === name; })[0]; }
  function options(select, texts, value) {
    if (!select) { return; }
    select.textContent = "";
    texts.forEach(function (text, k) { select.add(new Option(text, String(k), false, k === value)); });
    var label = select.closest("label");
    if (label) { label.hidden = texts.length < 2 && !select.classList.contains("model"); }
  }
  function on(id, event, what) { var e = byId(id); if (e) { e.addEventListener(event, what); } }

  /* Figures: embedded when they come near, filled by the names of their models. */
  function set(figure, name, properties) {
    var model = documents[figure] && documents[figure].get_model_by_name(name);
    if (!model) { return; }
    model.setv(properties);
    if ("start" in properties) { model.setv({ reset_start: properties.start, reset_end: properties.end }); } /* where the toolbar's reset leads */
  }
  function columns(figure, name, values) { set(figure, name, { data: values }); }
  function style(figure) {
    var css = getComputedStyle(document.documentElement), narrow = window.innerWidth < 700;
    var ink = css.getPropertyValue("--ink").trim(), line = css.getPropertyValue("--line").trim(), paper = css.getPropertyValue("--paper").trim();
    documents[figure]._all_models.forEach(function (m) {
      if (m.type.slice(-4) === "Axis" || m.type === "ColorBar") {
        m.setv({ major_label_text_color: ink });
        if (m.type !== "ColorBar") { m.setv({ axis_label_text_color: ink, axis_line_color: ink, major_tick_line_color: ink, minor_tick_line_color: null }); }
        else { m.setv({ background_fill_color: null }); }
      } else if (m.type === "Grid") { m.setv({ grid_line_color: line }); }
      else if (m.type === "Legend") { m.setv({ label_text_color: ink, background_fill_color: paper, orientation: narrow ? "vertical" : "horizontal", spacing: narrow ? -4 : 14 }); if (m.ncols !== "auto") { m.setv({ ncols: narrow ? 1 : 2 }); } }
      else if (m.tags && m.tags.indexOf("ink") >= 0) { m.setv({ line_color: ink }); }
    });
  }
  function followTicks(figure) {
    documents[figure]._all_models.forEach(function (ticker) {
      if (!ticker.name || ticker.name.slice(-6) !== ".ticks") { return; }
      var range = documents[figure].get_model_by_name(ticker.name.slice(0, -6));
      function follow() { ticker.setv({ ticks: EmaNumbers.ticksOf(Math.min(range.start, range.end), Math.max(range.start, range.end)) }); }
      range.change.connect(follow);
      follow();
    });
  }
  function embed(place) {
    var figure = place.dataset.figure;
    if (place.dataset.state || !data.items[figure]) { return; }
    place.dataset.state = "loading";
    if (!place.id) { place.id = "figure-" + figure; }
    Promise.resolve(Bokeh.embed.embed_item(data.items[figure], place.id)).then(function (views) {
      var root = views.roots ? views.roots[0] : views[0];
      documents[figure] = root.model.document;
      followTicks(figure);
      style(figure);
      fill[figure]();
      if (figure === "stab") { followPoles(); }
      place.style.minHeight = "0";
      place.dataset.state = "shown";
    });
  }
  /* A pole of the stabilisation chart that is clicked: its mode is chosen; of one without a mode the page is told. */
  function followPoles() {
    ["loose", "stable", "voted"].forEach(function (key) {
      var source = documents.stab.get_model_by_name("stab." + key);
      source.selected.change.connect(function () {
        var k = source.selected.indices[0], f = source.data.f[k], c = currentConfiguration();
        if (k === undefined || !c) { return; }
        if (key !== "voted") { document.dispatchEvent(new CustomEvent("pole", { detail: f })); return; }
        var off = c.modes.map(function (m) { return Math.abs(m.f - f); });
        chosen.picked = true;
        chooseMode(c.name, off.indexOf(Math.min.apply(null, off)));
      });
    });
  }
  function watch() {
    var places = Array.prototype.slice.call(document.querySelectorAll("[data-figure]"));
    if (!("IntersectionObserver" in window)) { places.forEach(embed); return; }
    var observer = new IntersectionObserver(function (entries) {
      entries.forEach(function (e) { if (e.isIntersecting) { embed(e.target); } });
    }, { rootMargin: "300px" });
    places.forEach(function (p) { observer.observe(p); });
    /* The page may be printed: what was not in view is drawn while nothing else is to be done. */
    var rests = window.requestIdleCallback || function (what) { window.setTimeout(what, 200); };
    function next() { var place = places.shift(); if (place) { embed(place); rests(next); } }
    rests(next);
    window.addEventListener("beforeprint", function () { places.splice(0).forEach(embed); });
  }
  function refill(names) { names.forEach(function (name) { if (documents[name]) { fill[name](); } }); }

  function frfConfigurations() { return measured().filter(function (c) { return c.frfs; }); }
  function listed(packed, which) {
    var seen = [];
    packed.pairs.forEach(function (p) {
      if (which === 1 && p[0] !== chosen.output) { return; }
      if (seen.indexOf(p[which]) < 0) { seen.push(p[which]); }
    });
    return seen.sort(function (a, b) { return a - b; });
  }
  /* The FRFs of a model: each part with its own deviation, or like parts alike. */
  function anyAlike() {
    return Object.keys(data.model.frfs).some(function (name) { return data.model.frfs[name].some(function (m) { return m.alike; }); });
  }
  function variant(models, k) {
    var box = byId("frf-alike"), m = models && models[k];
    return m ? (box && box.checked && m.alike) || m.own : null;
  }
  /* The FRF in which the compared models differ most at the modes: the first that is shown. */
  function tellingFrf() {
    var best = 0;
    frfConfigurations().forEach(function (c, number) {
      var models = data.model.frfs[c.name] || [], f = c.modes.map(function (m) { return m.f; });
      var largest = Math.max.apply(null, c.frfs.pairs.map(function (p) { var a = modelled(variant(models, chosen.before), p[0], p[1], f); return a ? Math.max.apply(null, Array.from(a.magnitude)) : 0; }));
      c.frfs.pairs.forEach(function (p) {
        var a = modelled(variant(models, chosen.before), p[0], p[1], f), b = modelled(variant(models, chosen.after), p[0], p[1], f), off = 0;
        if (a && b && largest > 0) { for (var k = 0; k < f.length; k++) { off += Math.pow((a.magnitude[k] - b.magnitude[k]) / largest, 2); } }
        if (off > best) { best = off; chosen.configuration = number; chosen.output = p[0]; chosen.input = p[1]; }
      });
    });
  }
  function chooseFrf() {
    var c = frfConfigurations()[chosen.configuration];
    if (!c) { return; }
    var outputs = listed(c.frfs, 0);
    if (outputs.indexOf(chosen.output) < 0) { chosen.output = outputs[0]; }
    var inputs = listed(c.frfs, 1);
    if (inputs.indexOf(chosen.input) < 0) { chosen.input = inputs[0]; }
    options(byId("frf-configuration"), frfConfigurations().map(function (x) { return x.name; }), chosen.configuration);
    options(byId("frf-output"), outputs.map(function (o) { return c.frfs.outputs[o]; }), outputs.indexOf(chosen.output));
    options(byId("frf-input"), inputs.map(function (i) { return c.frfs.inputs[i]; }), inputs.indexOf(chosen.input));
    var note = byId("frf-note"), hits = c.frfs.pairs.filter(function (p) { return p[0] === chosen.output && p[1] === chosen.input; })[0][2];
    var some = c.frfs.pairs.length < c.frfs.total ? "; " + c.frfs.pairs.length + " of " + c.frfs.total + " FRFs are kept in this page" : "";
    note.textContent = c.name + ": " + c.frfs.outputs[chosen.output] + " ← " + c.frfs.inputs[chosen.input] + ", " + (hits === 1 ? "one " + c.frfs.average + ": no coherence, no scatter" : "mean of " + hits + " " + c.frfs.average + "s") + some + rest(c) + said(c.frfs.levels) + coherences(c.frfs);
    refill(["frf"]);
  }
  /* Where the measurement goes on beyond the modes, which the figure begins with. */
  function rest(c) {
    var last = c.frfs.start + (c.frfs.lines - 1) * c.frfs.step;
    return c.shown_to < 0.99 * last ? "; shown up to " + Number(c.shown_to.toPrecision(3)) + " Hz, measured up to " + Number(last.toPrecision(4)) + " Hz: the tools beside it zoom and pan" : "";
  }
  function said(levels) { return levels ? ". Shaded: noise, 1σ of the mean; hatched: nonlinear distortion, 1σ of one realisation; triangles and squares: distortion at odd and even lines that carry no force." : ""; }
  function coherences(packed) { return packed.multiple ? ". Coherence: solid, the partial one of this force without what the others explain; dashed, the multiple one of all forces together." : ""; }
  function empty(names) { var out = {}; names.forEach(function (n) { out[n] = []; }); return out; }
  function shortModel(k) { return data.model.models[k] || "model"; }

  /* Curves, with their entry in the legend, that a test has or has not. */
  function shown(figure, name, there) {
    documents[figure]._all_models.forEach(function (m) {
      if (m.type === "LegendItem" && m.renderers.some(function (r) { return r.name === name; })) { m.setv({ visible: there }); }
      if (m.name === name) { m.setv({ visible: there }); }
    });
  }
  function calculated(k) {
    return Object.keys(data.model.frfs).some(function (name) { var m = data.model.frfs[name][k]; return m && (m.own || m.alike); });
  }
  /* Names of the models that are compared; a curve that is not there has no entry. */
  function legend(figure) {
    documents[figure]._all_models.forEach(function (m) {
      if (m.type !== "LegendItem") { return; }
      m.renderers.forEach(function (r) {
        var key = r.name && r.name.split(".")[1];
        if (key === "before" || key === "after") {
          var there = (key === "before" || chosen.after !== chosen.before) && (figure !== "frf" || calculated(chosen[key]));
          m.setv({ label: { value: shortModel(chosen[key]) }, visible: there });
          r.setv({ visible: there });
        }
      });
    });
  }

  function matrices() {
    var all = [];
    measured().forEach(function (c) {
      var m = data.model.mac[c.name], labels = c.modes.map(function (x, k) { return (k + 1) + ": " + Number(x.f.toPrecision(5)); });
      if (m) { all.push({ name: c.name + ": measured with model", values: m.values, x: m.model, y: labels, pairs: m.pairs, label: "model mode, Hz" }); }
      if (c.auto_mac) { all.push({ name: c.name + ": measured with each other", values: c.auto_mac, x: labels, y: labels, pairs: [], label: "measured mode, Hz" }); }
    });
    return all;
  }

  /* Modes: one is chosen, and everything about it is shown. */
  function currentConfiguration() { return chosen.mode && named(chosen.mode[0]); }
  function currentMode() { var c = currentConfiguration(); return c && c.modes[chosen.mode[1]]; }
  function markMode() {
    var mode = currentMode(), c = frfConfigurations()[chosen.configuration];
    var here = chosen.picked && mode && c && c.name === chosen.mode[0];
    set("frf", "frf.selected", { data: { f: here ? [mode.f] : [] } });
    set("stab", "stab.selected", { data: { f: mode ? [mode.f] : [] } });
  }
  function chooseMode(configuration, index) {
    chosen.mode = [configuration, index]; chosen.circle = 0;
    document.querySelectorAll("button.pick").forEach(function (b) {
      var mine = b.dataset.configuration === configuration && Number(b.dataset.mode) === index;
      b.setAttribute("aria-pressed", String(mine));
      b.closest("tr").classList.toggle("chosen", mine);
    });
    document.querySelectorAll(".shape-set").forEach(function (s) {
      s.hidden = s.dataset.configuration !== configuration;
      s.querySelectorAll("figure.shape").forEach(function (f) { f.hidden = Number(f.dataset.mode) !== index; });
    });
    var mode = currentMode();
    if (byId("mode-title")) { byId("mode-title").textContent = configuration + ", " + mode.title; }
    options(byId("nyquist-pick"), mode.circles.map(function (c) { return c.name; }), 0);
    circleText();
    refill(["nyquist", "stab", "shape"]);
    markMode();
    drawShapes();
  }
  function circleText() {
    var mode = currentMode(), place = byId("nyquist-text");
    if (place) { place.textContent = mode && mode.circles.length ? mode.circles[chosen.circle].text : "no circle fit for this mode"; }
  }

  /* Shapes in motion. */
  var phase = 0, last = null;
  function drawShapes() {
    var c = Math.cos(phase), s = Math.sin(phase);
    document.querySelectorAll(".shape-set:not([hidden]) figure.shape:not([hidden]) svg[data-motion]").forEach(function (svg) {
      var bodies = svg.querySelectorAll("g.body");
      JSON.parse(svg.dataset.motion).forEach(function (m, i) {
        var x = m[0] + m[2] * c - m[3] * s, y = m[1] + m[4] * c - m[5] * s, r = m[6] * c - m[7] * s;
        bodies[i].setAttribute("transform", "translate(" + x.toFixed(2) + " " + y.toFixed(2) + ") rotate(" + r.toFixed(2) + ")");
      });
    });
  }
  function step(now) {
    if (!playing) { last = null; return; }
    if (last !== null) { phase = (phase + (now - last) / 1600 * 2 * Math.PI) % (2 * Math.PI); }
    last = now; drawShapes(); window.requestAnimationFrame(step);
  }
  function play(wanted) {
    if (wanted && !playing) { window.requestAnimationFrame(step); }
    playing = wanted;
    document.querySelectorAll("button.play").forEach(function (b) {
      b.hidden = false; b.textContent = wanted ? "❚❚ Pause" : "▶ Play"; b.setAttribute("aria-pressed", String(wanted));
    });
  }

  var fill = EmaFigures({
    model: function () { return data.model; },
    byId: byId, set: set, columns: columns, empty: empty, shown: shown, legend: legend,
    markMode: markMode, modelled: modelled, variant: variant, matrices: matrices, currentMode: currentMode, currentConfiguration: currentConfiguration,
    named: named, measured: measured, frfConfigurations: frfConfigurations, documents: documents, chosen: chosen
  });
  function chooseModels() {
    var count = data.model.models.length;
    chosen.before = Math.min(chosen.before, count - 1); chosen.after = Math.min(chosen.after, count - 1);
    options(byId("model-before"), data.model.models, chosen.before);
    options(byId("model-after"), data.model.models, chosen.after);
    document.querySelectorAll("select.model").forEach(function (s) { s.closest("label").hidden = count < 2; });
  }
  function newModel(model) {
    data.model = model;
    chosen.before = 0; chosen.after = Math.min(1, model.models.length - 1);
    chooseModels();
    options(byId("mac-pick"), matrices().map(function (m) { return m.name; }), 0);
    refill(Object.keys(fill));
    if (chosen.mode) { chooseMode(chosen.mode[0], chosen.mode[1]); }
  }
  function copied(button, text) {
    function done() { var was = button.textContent; button.textContent = "Copied"; setTimeout(function () { button.textContent = was; }, 1500); }
    if (navigator.clipboard && window.isSecureContext) { navigator.clipboard.writeText(text).then(done, byHand); } else { byHand(); }
    function byHand() {
      var area = document.createElement("textarea");
      area.value = text; document.body.appendChild(area); area.select();
      document.execCommand("copy"); area.remove(); done();
    }
  }

  function start(all) {
    data = all;
    chosen.after = Math.min(1, data.model.models.length - 1);
    on("frf-configuration", "change", function (e) { chosen.configuration = Number(e.target.value); chooseFrf(); });
    on("frf-output", "change", function (e) { chosen.output = listed(frfConfigurations()[chosen.configuration].frfs, 0)[Number(e.target.value)]; chooseFrf(); });
    on("frf-input", "change", function (e) { chosen.input = listed(frfConfigurations()[chosen.configuration].frfs, 1)[Number(e.target.value)]; chooseFrf(); });
    ["before", "after"].forEach(function (key) { on("model-" + key, "change", function (e) { chosen[key] = Number(e.target.value); refill(["frf", "errors", "moved"]); }); });
    ["frf-linear", "frf-band", "frf-alike"].forEach(function (id) { on(id, "change", function () { refill(["frf"]); }); });
    on("errors-quantity", "change", function () { refill(["errors"]); });
    on("mac-pick", "change", function () { refill(["mac"]); });
    on("loops-pick", "change", function () { refill(["loops"]); });
    on("nyquist-pick", "change", function (e) { chosen.circle = Number(e.target.value); circleText(); refill(["nyquist"]); });
    document.addEventListener("click", function (e) {
      var pick = e.target.closest("button.pick"), copy = e.target.closest("button.copy");
      if (pick) { chosen.picked = true; chooseMode(pick.dataset.configuration, Number(pick.dataset.mode)); }
      if (copy) { copied(copy, copy.dataset.copy); }
      if (e.target.closest("button.play")) { play(!playing); }
    });
    chooseModels();
    if (byId("frf-alike")) { byId("frf-alike").checked = anyAlike(); byId("frf-alike").parentNode.hidden = !anyAlike(); }
    tellingFrf();
    chooseFrf();
    options(byId("mac-pick"), matrices().map(function (m) { return m.name; }), 0);
    options(byId("loops-pick"), ["all"].concat(data.model.loops.map(function (l) { return l.name; })), 0);
    var first = document.querySelector("button.pick");
    if (first) { chooseMode(first.dataset.configuration, Number(first.dataset.mode)); }
    play(false);
    watch();
    if (window.matchMedia) {
      /* legends of a narrow page stand below each other */
      ["(prefers-color-scheme: dark)", "(max-width: 699px)"].forEach(function (what) {
        window.matchMedia(what).addEventListener("change", function () { Object.keys(documents).forEach(style); });
      });
    }
    document.documentElement.dataset.ready = "yes";
  }
  return { start: start, newModel: newModel, copied: copied, configuration: function () { return chosen.mode && chosen.mode[0]; } };
}());
