/* Fills every figure with what is chosen on the page: one function per figure. */
function EmaFigures(page) {
  "use strict";
  var byId = page.byId, set = page.set, columns = page.columns, empty = page.empty,
    shown = page.shown, legend = page.legend, markMode = page.markMode, modelled = page.modelled,
    variant = page.variant, matrices = page.matrices, currentMode = page.currentMode, currentConfiguration = page.currentConfiguration,
    named = page.named, measured = page.measured, frfConfigurations = page.frfConfigurations, documents = page.documents,
    chosen = page.chosen;
  return {
    frf: function () {
      var c = frfConfigurations()[chosen.configuration], packed = c.frfs;
      EmaNumbers.unpacked(c).then(function (all) {
        var k = packed.pairs.findIndex(function (p) { return p[0] === chosen.output && p[1] === chosen.input; });
        var rowed = EmaNumbers.row(all, packed, k, byId("frf-band").checked), models = page.model().frfs[c.name] || [];
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
        var start = lines.length ? Math.max(all.f[0], 0.4 * Math.min.apply(null, lines)) : all.f[0], end = Math.min(c.shown_to, all.f[all.f.length - 1]);
        var low = Infinity, sizes = Array.prototype.filter.call(rowed.magnitude, function (_, i) { return all.f[i] >= start && all.f[i] <= end; }).sort(function (a, b) { return a - b; });
        var high = sizes[sizes.length - 1] * 2;
        low = sizes[Math.floor(0.005 * sizes.length)] / 2;
        if (banded && quiet.length) { quiet.sort(function (a, b) { return a - b; }); low = Math.min(low, quiet[Math.floor(0.02 * quiet.length)] / 3); }
        low = Math.max(low, high * 1e-7);
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
      var e = page.model().errors, quantity = (byId("errors-quantity") || { value: "largest" }).value;
      function size(k, i) {
        var m = e.models[k];
        if (!m) { return null; }
        if (quantity !== "largest") { return m[quantity][i]; }
        var all = ["frequency", "damping", "shape"].map(function (q) { return m[q][i]; }).filter(function (v) { return v !== null; });
        return all.length ? Math.max.apply(null, all) : null;
      }
      function factor(m) { return m[0] ? [m[0], m[1]] : m[1]; }
      var several = e.modes.concat(page.model().lone).some(function (m) { return m[0]; });
      var lone = page.model().lone, every = e.modes.map(function (m) { return m.slice(0, 2); });
      lone.forEach(function (m) {  // one without a partner in this model may have one in another
        if (!every.some(function (o) { return o[0] === m[0] && o[1] === m[1]; })) { every.push(m.slice(0, 2)); }
      });
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
      var m = page.model().moved, names = m.names, same = chosen.after === chosen.before;
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
      var rungs = page.model().ladder, names = rungs.map(function (r, k) { return k + ": " + r.name; });
      var top = Math.max.apply(null, [2].concat(rungs.map(function (r) { return Math.max(r.error || 0, r.held || 0); })));
      set("ladder", "ladder.x", { factors: names });
      set("ladder", "ladder.y", { start: 0, end: 1.25 * top });
      columns("ladder", "ladder.rungs", { model: names, error: rungs.map(function (r) { return r.error; }), held: rungs.map(function (r) { return r.held; }), words: names });
    },
    nyquist: function () {
      var mode = currentMode(), circle = mode && mode.circles[chosen.circle];
      var angle = []; for (var k = 0; k <= 120; k++) { angle.push(2 * Math.PI * k / 120); }
      var power = circle ? Math.floor(Math.log10(2 * circle.radius)) : 0, k1 = Math.pow(10, -power), c0 = named(chosen.mode[0]);
      var unit = EmaNumbers.power(power) + "(m/s)/" + (c0.scale || "N");
      function scaled(values) { return values.map(function (v) { return k1 * v; }); }
      set("nyquist", "nyquist.x_axis", { axis_label: "Re mobility, " + unit }); set("nyquist", "nyquist.y_axis", { axis_label: "Im mobility, " + unit });
      columns("nyquist", "nyquist.points", circle ? { re: scaled(circle.re), im: scaled(circle.im), f: circle.f } : empty(["re", "im", "f"]));
      columns("nyquist", "nyquist.circle", circle ? { re: angle.map(function (a) { return k1 * (circle.centre[0] + circle.radius * Math.cos(a)); }), im: angle.map(function (a) { return k1 * (circle.centre[1] + circle.radius * Math.sin(a)); }) } : empty(["re", "im"]));
      columns("nyquist", "nyquist.marks", circle && circle.mark ? { re: [k1 * circle.mark[0]], im: [k1 * circle.mark[1]], text: ["pole"] } : empty(["re", "im", "text"]));
      shown("nyquist", "nyquist.pole", Boolean(circle && circle.mark));
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
      Object.keys(groups).forEach(function (key) {
        columns("stab", "stab." + key, groups[key]);
        shown("stab", "stab.poles." + key, groups[key].f.length > 0);
      });
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
      var c = currentConfiguration(), all = c && page.model().shapes[c.name], s = all && all[chosen.mode && chosen.mode[1]];
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
    loops: function () {
      var pick = (byId("loops-pick") || { value: "0" }).value, some = page.model().loops.filter(function (_, k) { return pick === "0" || Number(pick) === k + 1; });
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
      page.model().loss.forEach(function (l, k) {
        var color = colors[k % colors.length];
        lines.xs.push(l.points.map(function (p) { return p[0]; })); lines.ys.push(l.points.map(function (p) { return p[1]; })); lines.text.push(l.name); lines.color.push(color);
        l.points.forEach(function (p) { dots.x.push(p[0]); dots.y.push(p[1]); dots.low.push(p[1] - 2 * p[2]); dots.high.push(p[1] + 2 * p[2]); dots.text.push(l.name); dots.color.push(color); });
      });
      columns("loss", "loss.lines", lines); columns("loss", "loss.points", dots);
    },
    sweeps: function () {
      var colors = ["#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9"], dashes = ["solid", "dashed", "dotted", "dotdash", "dashdot", "dashed"], s = page.model().sweeps;
      columns("sweeps", "sweeps.lines", { xs: s.map(function (x) { return x.x; }), ys: s.map(function (x) { return x.y.map(function (v) { return v === null ? NaN : v; }); }), text: s.map(function (x) { return x.text; }), color: s.map(function (_, k) { return colors[k % colors.length]; }), dash: s.map(function (_, k) { return dashes[k % dashes.length]; }) });
    }
  };
}
