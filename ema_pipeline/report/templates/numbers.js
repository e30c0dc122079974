/* Numbers of the page: FRFs unpacked, models summed over their poles, ticks of logarithmic axes. */
var EmaNumbers = (function () {
  "use strict";
  var frfs = {};

  /* Measured FRFs: unpacked once per configuration. */
  function inflate(text) {
    var bytes = Uint8Array.from(atob(text), function (c) { return c.charCodeAt(0); });
    var stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
    return new Response(stream).arrayBuffer().then(function (b) { return new Uint8Array(b); });
  }
  function words16(planes, lines) {
    var n = planes.length / 2, out = new Uint16Array(n), last = 0;
    for (var k = 0; k < n; k++) {
      if (k % lines === 0) { last = 0; }
      last = (last + planes[k] + 256 * planes[n + k]) & 65535;
      out[k] = last;
    }
    return out;
  }
  function unpacked(configuration) {
    var packed = configuration.frfs;
    if (!frfs[configuration.name]) {
      frfs[configuration.name] = Promise.all(["magnitude", "phase", "coherence", "sigma", "multiple"].map(function (key) { return packed[key] && inflate(packed[key]); })).then(function (raw) {
        var levels = Object.keys(packed.levels || {});
        return Promise.all(levels.map(function (key) { return inflate(packed.levels[key]); })).then(function (more) {
        var f = new Float64Array(packed.lines), level = {};
        levels.forEach(function (key, k) { level[key] = words16(more[k], packed.lines); });
        for (var k = 0; k < packed.lines; k++) { f[k] = packed.start + k * packed.step; }
        return { f: f, magnitude: words16(raw[0], packed.lines), phase: words16(raw[1], packed.lines), coherence: raw[2], sigma: raw[3], multiple: raw[4], level: level };
        });
      });
    }
    return frfs[configuration.name];
  }
  function coherence(step) { return step === 255 ? NaN : step / 250; }
  /* One FRF with its band of two standard deviations, where that is wanted. */
  function row(all, packed, k, banded) {
    var n = packed.lines, low = packed.decades[0], span = packed.decades[1] - low;
    var out = { f: all.f, magnitude: new Float64Array(n), phase: new Float64Array(n), coherence: new Float64Array(n), multiple: new Float64Array(n), low: new Float64Array(n), high: new Float64Array(n) };
    var last = 0;
    for (var i = 0; i < n; i++) {
      var at = k * n + i, size = Math.pow(10, low + span * all.magnitude[at] / 65534), phase = 360 * all.phase[at] / 65535 - 180;
      var share = all.sigma[at] === 255 || !banded ? NaN : Math.pow(10, packed.sigma_decades[0] + (packed.sigma_decades[1] - packed.sigma_decades[0]) * all.sigma[at] / 254);
      out.magnitude[i] = size;
      out.phase[i] = i && Math.abs(phase - last) > 180 ? NaN : phase;
      last = phase;
      out.coherence[i] = coherence(all.coherence[at]);
      out.multiple[i] = all.multiple ? coherence(all.multiple[at]) : NaN;
      out.low[i] = size * Math.max(1 - 2 * share, 0.02);
      out.high[i] = size * (1 + 2 * share);
    }
    return out;
  }
  /* Noise and distortion of one FRF, each with the lines at which it is known. */
  function levels(all, packed, k) {
    var n = packed.lines, low = packed.decades[0], span = packed.decades[1] - low, out = {};
    ["noise", "distortion", "odd", "even"].forEach(function (key) {
      var words = all.level[key], f = [], level = [];
      for (var i = 0; words && i < n; i++) {
        if (words[k * n + i] !== 65535) { f.push(all.f[i]); level.push(Math.pow(10, low + span * words[k * n + i] / 65534)); }
      }
      out[key] = { f: f, level: level, floor: level.map(function () { return Math.pow(10, low); }) };
    });
    return out;
  }
  /* Acceleration over force of a model: the sum over its poles. */
  function modelled(model, output, input, f) {
    if (!model || !model.outputs[output] || !model.inputs[input]) { return null; }
    var poles = model.poles, o = model.outputs[output], q = model.inputs[input], n = poles[0].length;
    var re = new Float64Array(n), im = new Float64Array(n);
    for (var r = 0; r < n; r++) {
      re[r] = o[0][r] * q[0][r] - o[1][r] * q[1][r];
      im[r] = o[0][r] * q[1][r] + o[1][r] * q[0][r];
    }
    var out = { f: f, magnitude: new Float64Array(f.length), phase: new Float64Array(f.length) }, last = 0;
    for (var i = 0; i < f.length; i++) {
      var w = 2 * Math.PI * f[i], a = 0, b = 0;
      for (r = 0; r < n; r++) {
        var x = -poles[0][r], y = w - poles[1][r], d = x * x + y * y;
        a += (re[r] * x + im[r] * y) / d;
        b += (im[r] * x - re[r] * y) / d;
      }
      a *= -w * w; b *= -w * w;
      var phase = 180 / Math.PI * Math.atan2(b, a);
      out.magnitude[i] = Math.hypot(a, b);
      out.phase[i] = i && Math.abs(phase - last) > 180 ? NaN : phase;
      last = phase;
    }
    return out;
  }

  /* Ticks of a logarithmic axis: 1, 2, 5 of every decade, or round steps where less than a decade is in view. */
  function ticksOf(low, high) {
    var ticks = [], k;
    if (!(low > 0) || !(high > low)) { return ticks; }
    var span = Math.log10(high / low);
    if (span < 0.9) {
      var step = Math.pow(10, Math.floor(Math.log10((high - low) / 4)));
      [5, 2].some(function (m) { if ((high - low) / (m * step) >= 4) { step *= m; return true; } return false; });
      for (k = Math.ceil(low / step); k * step <= high; k++) { ticks.push(Number((k * step).toPrecision(8))); }
      return ticks;
    }
    var mantissas = span < 4 ? [1, 2, 5] : [1];
    for (k = Math.floor(Math.log10(low)); k <= Math.ceil(Math.log10(high)); k++) {
      mantissas.forEach(function (m) { var t = m * Math.pow(10, k); if (t >= low && t <= high) { ticks.push(Number(t.toPrecision(3))); } });
    }
    return ticks;
  }
  /* A power of ten before a unit; nothing for 10⁰. */
  function power(exponent) {
    var digits = String(exponent).replace(/[-0-9]/g, function (c) { return "⁻⁰¹²³⁴⁵⁶⁷⁸⁹".charAt("-0123456789".indexOf(c)); });
    return exponent ? "10" + digits + " " : "";
  }
  return { unpacked: unpacked, row: row, levels: levels, modelled: modelled, ticksOf: ticksOf, power: power };
}());
