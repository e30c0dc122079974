/* Fills the figures of the report and of the live page with data, and follows what the reader chooses. */
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
    if (model) { model.setv(properties); }
  }
  function columns(figure, name, values) { set(figure, name, { data: values }); }
  function style(figure) {
    var css = getComputedStyle(document.documentElement);
    var ink = css.getPropertyValue("--ink").trim(), line = css.getPropertyValue("--line").trim(), paper = css.getPropertyValue("--paper").trim();
    documents[figure]._all_models.forEach(function (m) {
      if (m.type.slice(-4) === "Axis" || m.type === "ColorBar") {
        m.setv({ major_label_text_color: ink });
        if (m.type !== "ColorBar") { m.setv({ axis_label_text_color: ink, axis_line_color: ink, major_tick_line_color: ink, minor_tick_line_color: null }); }
        else { m.setv({ background_fill_color: null }); }
      } else if (m.type === "Grid") { m.setv({ grid_line_color: line }); }
      else if (m.type === "Legend") { m.setv({ label_text_color: ink, background_fill_color: paper, orientation: window.innerWidth < 700 ? "vertical" : "horizontal" }); }
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
    note.textContent = c.name + ": " + c.frfs.outputs[chosen.output] + " ← " + c.frfs.inputs[chosen.input] + ", " + (hits === 1 ? "one " + c.frfs.average + ": no coherence, no scatter" : "mean of " + hits + " " + c.frfs.average + "s") + some + said(c.frfs.levels);
    refill(["frf"]);
  }
  function said(levels) { return levels ? ". Shaded: noise, 1σ of the mean; hatched: nonlinear distortion, 1σ of one realisation; triangles and squares: distortion at odd and even lines that carry no force." : ""; }
  function empty(names) { var out = {}; names.forEach(function (n) { out[n] = []; }); return out; }
  function shortModel(k) { return data.model.models[k] || "model"; }

  /* Curves, with their entry in the legend, that a test has or has not. */
  function shown(figure, name, there) {
    documents[figure]._all_models.forEach(function (m) {
      if (m.type === "LegendItem" && m.renderers.some(function (r) { return r.name === name; })) { m.setv({ visible: there }); }
      if (m.name === name) { m.setv({ visible: there }); }
    });
  }
  /* Names of the models that are compared; a curve that is not there has no entry. */
  function legend(figure) {
    documents[figure]._all_models.forEach(function (m) {
      if (m.type !== "LegendItem") { return; }
      m.renderers.forEach(function (r) {
        var key = r.name && r.name.split(".")[1];
        if (key === "before" || key === "after") {
          var there = key === "before" || chosen.after !== chosen.before;
          m.setv({ label: { value: shortModel(chosen[key]) }, visible: there });
          r.setv({ visible: there });
        }
      });
    });
  }

  var fill = {
    frf: function () {
      var c = frfConfigurations()[chosen.configuration], packed = c.frfs;
      EmaNumbers.unpacked(c).then(function (all) {
        var k = packed.pairs.findIndex(function (p) { return p[0] === chosen.output && p[1] === chosen.input; });
        var rowed = EmaNumbers.row(all, packed, k, byId("frf-band").checked), models = data.model.frfs[c.name] || [];
        columns("frf", "frf.measured", rowed);
        var levels = EmaNumbers.levels(all, packed, k), banded = byId("frf-band").checked, quiet = [];
        Object.keys(levels).forEach(function (key) {
          quiet = quiet.concat(levels[key].level);
          columns("frf", "frf." + key, banded ? levels[key] : empty(["f", "level", "floor"]));
          shown("frf", "frf.level." + key, banded && levels[key].f.length > 0);
        });
        ["before", "after"].forEach(function (key) {
          var hidden = key === "after" && chosen.after === chosen.before;
          var curve = hidden ? null : modelled(variant(models, chosen[key]), chosen.output, chosen.input, all.f);
          columns("frf", "frf." + key, curve || empty(["f", "magnitude", "phase"]));
        });
        legend("frf");
        var lines = c.modes.map(function (m) { return m.f; });
        columns("frf", "frf.modes", { f: lines, text: lines.map(function (_, i) { return String(i + 1); }) });
        markMode();
        var low = Infinity, sizes = Array.prototype.slice.call(rowed.magnitude).sort(function (a, b) { return a - b; });
        var high = sizes[sizes.length - 1] * 2, end = all.f[all.f.length - 1];
        low = sizes[Math.floor(0.005 * sizes.length)] / 2;
        if (banded && quiet.length) { quiet.sort(function (a, b) { return a - b; }); low = Math.min(low, quiet[Math.floor(0.02 * quiet.length)] / 3); }
        low = Math.max(low, high * 1e-7);
        var start = lines.length ? Math.max(all.f[0], 0.4 * Math.min.apply(null, lines)) : all.f[0];
        if (documents.frf.shownFor !== c.name) { set("frf", "frf.x", { start: start, end: end }); documents.frf.shownFor = c.name; }
        set("frf", "frf.log.y", { start: low, end: high });
        set("frf", "frf.lin.y", { start: 0, end: high / 1.9 });
        var label = { axis_label: "|accelerance|, " + packed.unit };
        set("frf", "frf.log.axis", label); set("frf", "frf.lin.axis", label);
        var linear = byId("frf-linear").checked;
        set("frf", "frf.log", { visible: !linear }); set("frf", "frf.lin", { visible: linear });
      });
    },
    errors: function () {
      var e = data.model.errors, quantity = (byId("errors-quantity") || { value: "largest" }).value;
      function size(k, i) {
        var m = e.models[k];
        if (!m) { return null; }
        if (quantity !== "largest") { return m[quantity][i]; }
        var all = ["frequency", "damping", "shape"].map(function (q) { return m[q][i]; }).filter(function (v) { return v !== null; });
        return all.length ? Math.max.apply(null, all) : null;
      }
      function factor(m) { return m[0] ? [m[0], m[1]] : m[1]; }
      var several = e.modes.concat(data.model.lone).some(function (m) { return m[0]; });
      var lone = data.model.lone, every = e.modes.map(function (m) { return m.slice(0, 2); });
      lone.forEach(function (m) { every.push(m.slice(0, 2)); });
      if (several) { var order = []; every.forEach(function (m) { if (order.indexOf(m[0]) < 0) { order.push(m[0]); } }); every.sort(function (a, b) { return order.indexOf(a[0]) - order.indexOf(b[0]) || parseInt(a[1], 10) - parseInt(b[1], 10); }); }
      else { every.sort(function (a, b) { return parseInt(a[1], 10) - parseInt(b[1], 10); }); }
      var before = e.modes.map(function (_, i) { return size(chosen.before, i); }), after = e.modes.map(function (_, i) { return chosen.after === chosen.before ? null : size(chosen.after, i); });
      var top = Math.max.apply(null, [5].concat(before, after)) * 1.5;
      set("errors", "errors.x", { factors: every.map(factor) });
      set("errors", "errors.y", { start: 0.1, end: top });
      function tall(v) { return v === null ? NaN : Math.max(v, 0.11); }
      function text(v) { return v === null ? "–" : v.toPrecision(3) + " σ"; }
      columns("errors", "errors.bars", { mode: e.modes.map(factor), before: before.map(tall), after: after.map(tall), bottom: before.map(function () { return 0.1; }), text_before: before.map(text), text_after: after.map(text), what: before.map(function () { return quantity; }) });
      columns("errors", "errors.lone", { mode: lone.map(factor), z: lone.map(function () { return top / 1.4; }), text: lone.map(function (m) { return m[2]; }) });
      legend("errors");
    },
    moved: function () {
      var m = data.model.moved, names = m.names, same = chosen.after === chosen.before;
      function sizes(k) { return names.map(function (_, i) { var v = m.models[k] && m.models[k][i]; return v === null || v === undefined ? NaN : Math.abs(v); }); }
      function texts(k) { return names.map(function (_, i) { var v = m.models[k] && m.models[k][i]; return v === null || v === undefined ? "–" : v.toFixed(1) + " σ"; }); }
      var before = sizes(chosen.before), after = same ? before.map(function () { return NaN; }) : sizes(chosen.after);
      var top = Math.max.apply(null, [4].concat(before, after).filter(isFinite));
      set("moved", "moved.y", { factors: names.slice().reverse() });
      set("moved", "moved.x", { start: 0, end: 1.08 * top });
      columns("moved", "moved.bars", { name: names, before: before, after: after, text_before: texts(chosen.before), text_after: texts(chosen.after) });
      legend("moved");
    },
    ladder: function () {
      var rungs = data.model.ladder, names = rungs.map(function (r, k) { return k + ": " + r.name; });
      var top = Math.max.apply(null, [2].concat(rungs.map(function (r) { return Math.max(r.error || 0, r.held || 0); })));
      set("ladder", "ladder.x", { factors: names });
      set("ladder", "ladder.y", { start: 0, end: 1.25 * top });
      columns("ladder", "ladder.rungs", { model: names, error: rungs.map(function (r) { return r.error; }), held: rungs.map(function (r) { return r.held; }), words: names });
    },
    nyquist: function () {
      var mode = currentMode(), circle = mode && mode.circles[chosen.circle];
      var angle = []; for (var k = 0; k <= 120; k++) { angle.push(2 * Math.PI * k / 120); }
      var power = circle ? Math.floor(Math.log10(2 * circle.radius)) : 0, k1 = Math.pow(10, -power), c0 = named(chosen.mode[0]);
      var unit = (power ? "10^" + power + " " : "") + "(m/s)/" + (c0.scale || "N");
      function scaled(values) { return values.map(function (v) { return k1 * v; }); }
      set("nyquist", "nyquist.x_axis", { axis_label: "Re mobility, " + unit }); set("nyquist", "nyquist.y_axis", { axis_label: "Im mobility, " + unit });
      columns("nyquist", "nyquist.points", circle ? { re: scaled(circle.re), im: scaled(circle.im), f: circle.f } : empty(["re", "im", "f"]));
      columns("nyquist", "nyquist.circle", circle ? { re: angle.map(function (a) { return k1 * (circle.centre[0] + circle.radius * Math.cos(a)); }), im: angle.map(function (a) { return k1 * (circle.centre[1] + circle.radius * Math.sin(a)); }) } : empty(["re", "im"]));
      columns("nyquist", "nyquist.marks", circle && circle.mark ? { re: [k1 * circle.mark[0]], im: [k1 * circle.mark[1]], text: ["pole"] } : empty(["re", "im", "text"]));
    },
    stab: function () {
      var c = currentConfiguration(), chart = c && c.chart;
      var groups = { loose: empty(["f", "order", "damping"]), stable: empty(["f", "order", "damping"]), voted: empty(["f", "order", "damping"]) };
      if (chart) {
        chart.order.forEach(function (order, k) {
          var g = groups[chart.mode[k] >= 0 ? "voted" : chart.stable[k] ? "stable" : "loose"];
          g.f.push(chart.f[k]); g.order.push(order); g.damping.push(chart.damping[k]);
        });
      }
      Object.keys(groups).forEach(function (key) { columns("stab", "stab." + key, groups[key]); });
      var top = chart ? 1.08 * Math.max.apply(null, chart.order.concat([1])) : 10, cmif = c && c.cmif;
      set("stab", "stab.y", { start: 0, end: top });
      var places = (c ? c.modes.map(function (m) { return m.f; }) : []).concat(chart ? chart.f : []).filter(function (f) { return f > 0; });
      if (places.length) { set("stab", "stab.x", { start: 0.8 * Math.min.apply(null, places), end: 1.05 * Math.max.apply(null, places) }); }
      if (cmif && cmif.value.length) {
        var logs = cmif.value.map(function (v) { return Math.log10(Math.max(v, 1e-30)); }), low = Math.min.apply(null, logs), high = Math.max.apply(null, logs);
        columns("stab", "stab.cmif", { f: cmif.f, y: logs.map(function (v) { return top * 0.95 * (v - low) / Math.max(high - low, 1e-9); }) });
      } else { columns("stab", "stab.cmif", empty(["f", "y"])); }
      markMode();
    },
    mac: function () {
      var pick = matrices()[Number((byId("mac-pick") || { value: 0 }).value)];
      if (!pick) { return; }
      var cells = empty(["x", "y", "value", "text", "label"]);
      pick.values.forEach(function (values, i) {
        values.forEach(function (v, j) {
          cells.x.push(pick.x[j]); cells.y.push(pick.y[i]); cells.value.push(v); cells.text.push(""); cells.label.push(pick.y[i] + " Hz with " + pick.x[j] + " Hz");
        });
      });
      set("mac", "mac.x", { factors: pick.x }); set("mac", "mac.y", { factors: pick.y });
      set("mac", "mac.x_axis", { axis_label: pick.label });
      columns("mac", "mac.cells", cells);
      columns("mac", "mac.pairs", { x: pick.pairs.map(function (p) { return pick.x[p[1]]; }), y: pick.pairs.map(function (p) { return pick.y[p[0]]; }) });
    },
    shape: function () {
      var c = currentConfiguration(), all = c && data.model.shapes[c.name], s = all && all[chosen.mode && chosen.mode[1]];
      if (!s) { return; }
      set("shape", "shape.x", { factors: s.dofs });
      columns("shape", "shape.measured", { dof: s.dofs, value: s.value, low: s.value.map(function (v, k) { return v - s.std[k]; }), high: s.value.map(function (v, k) { return v + s.std[k]; }), zero: s.value.map(function () { return 0; }) });
      columns("shape", "shape.model", s.model ? { dof: s.dofs, value: s.model } : empty(["dof", "value"]));
    },
    levels: function () {
      var lines = empty(["xs", "ys", "text", "color", "width"]), dots = empty(["x", "y", "low", "high", "text", "color"]);
      measured().forEach(function (c) {
        (c.levels || []).forEach(function (m) {
          var color = m.depends ? "#D55E00" : "#8a929a", text = c.name + ", " + m.title;
          lines.xs.push(m.force); lines.ys.push(m.change.map(function (v) { return v === null ? NaN : v; })); lines.text.push(text); lines.color.push(color); lines.width.push(m.depends ? 2.5 : 1);
          m.force.forEach(function (f, k) {
            if (m.change[k] === null) { return; }
            dots.x.push(f); dots.y.push(m.change[k]); dots.low.push(m.change[k] - (m.std[k] || 0)); dots.high.push(m.change[k] + (m.std[k] || 0)); dots.text.push(text); dots.color.push(color);
          });
        });
      });
      columns("levels", "levels.lines", lines); columns("levels", "levels.points", dots);
    },
    traces: function () {
      var t = data.model.traces[Number((byId("traces-pick") || { value: 0 }).value)];
      if (!t) { return; }
      columns("traces", "traces.signals", { t: t.signals[0].map(function (_, k) { return k * t.step; }), measured: t.signals[0], before: t.signals[1], after: t.signals[2] });
      set("traces", "traces.axis", { axis_label: t.quantity + ", " + ({ acceleration: "m/s²", velocity: "m/s", displacement: "m" }[t.quantity] || "") });
    },
    loops: function () {
      var pick = (byId("loops-pick") || { value: "0" }).value, some = data.model.loops.filter(function (_, k) { return pick === "0" || Number(pick) === k + 1; });
      var curves = empty(["x", "measured", "before", "after"]), left = empty(["share", "before", "after"]);
      some.forEach(function (l) {
        var models = [l.models[0], chosen.after === chosen.before ? null : l.models[1]];
        l.x.concat(l.x[0], NaN).forEach(function (x, i) { /* closed, and apart from the next one */
          var k = i < l.x.length ? i : 0;
          function at(values) { return values && !isNaN(x) ? values[k] : NaN; }
          curves.x.push(x); curves.measured.push(at(l.measured)); curves.before.push(at(models[0])); curves.after.push(at(models[1]));
        });
        l.share.concat(NaN).forEach(function (share, k) {
          function off(values) { return values && k < l.share.length ? l.measured[k] - values[k] : NaN; }
          left.share.push(share); left.before.push(off(models[0])); left.after.push(off(models[1]));
        });
      });
      columns("loops", "loops.curves", curves); columns("loops", "loops.left", left);
      legend("loops");
    },
    loss: function () {
      var colors = ["#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9"], lines = empty(["xs", "ys", "text", "color"]), dots = empty(["x", "y", "low", "high", "text", "color"]);
      data.model.loss.forEach(function (l, k) {
        var color = colors[k % colors.length];
        lines.xs.push(l.points.map(function (p) { return p[0]; })); lines.ys.push(l.points.map(function (p) { return p[1]; })); lines.text.push(l.name); lines.color.push(color);
        l.points.forEach(function (p) { dots.x.push(p[0]); dots.y.push(p[1]); dots.low.push(p[1] - 2 * p[2]); dots.high.push(p[1] + 2 * p[2]); dots.text.push(l.name); dots.color.push(color); });
      });
      columns("loss", "loss.lines", lines); columns("loss", "loss.points", dots);
    },
    sweeps: function () {
      var colors = ["#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9"], s = data.model.sweeps;
      columns("sweeps", "sweeps.lines", { xs: s.map(function (x) { return x.x; }), ys: s.map(function (x) { return x.y.map(function (v) { return v === null ? NaN : v; }); }), text: s.map(function (x) { return x.text; }), color: s.map(function (_, k) { return colors[k % colors.length]; }) });
    }
  };

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
    document.querySelectorAll(".gear-set").forEach(function (s) {
      s.hidden = s.dataset.configuration !== configuration;
      s.querySelectorAll("figure.gear").forEach(function (f) { f.hidden = Number(f.dataset.mode) !== index; });
    });
    var mode = currentMode();
    if (byId("mode-title")) { byId("mode-title").textContent = configuration + ", " + mode.title; }
    options(byId("nyquist-pick"), mode.circles.map(function (c) { return c.name; }), 0);
    circleText();
    refill(["nyquist", "stab", "shape"]);
    markMode();
    drawGears();
  }
  function circleText() {
    var mode = currentMode(), place = byId("nyquist-text");
    if (place) { place.textContent = mode && mode.circles.length ? mode.circles[chosen.circle].text : "no circle fit for this mode"; }
  }

  /* Shapes in motion. */
  var phase = 0, last = null;
  function drawGears() {
    var c = Math.cos(phase), s = Math.sin(phase);
    document.querySelectorAll(".gear-set:not([hidden]) figure.gear:not([hidden]) svg[data-motion]").forEach(function (svg) {
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
    last = now; drawGears(); window.requestAnimationFrame(step);
  }
  function play(wanted) {
    if (wanted && !playing) { window.requestAnimationFrame(step); }
    playing = wanted;
    document.querySelectorAll("button.play").forEach(function (b) {
      b.hidden = false; b.textContent = wanted ? "❚❚ Pause" : "▶ Play"; b.setAttribute("aria-pressed", String(wanted));
    });
  }

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
    on("traces-pick", "change", function () { refill(["traces"]); });
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
    options(byId("traces-pick"), data.model.traces.map(function (t) { return t.name; }), 0);
    var first = document.querySelector("button.pick");
    if (first) { chooseMode(first.dataset.configuration, Number(first.dataset.mode)); }
    play(false);
    watch();
    if (window.matchMedia) {
      window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", function () { Object.keys(documents).forEach(style); });
    }
    document.documentElement.dataset.ready = "yes";
  }
  return { start: start, newModel: newModel, copied: copied, configuration: function () { return chosen.mode && chosen.mode[0]; } };
}());
