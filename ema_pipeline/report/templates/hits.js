/* The live page of a raw folder: shows the state that the server tells. All names are set as text. */
(function () {
  "use strict";
  var MARKS = { good: "✓", care: "!", bad: "✗" };
  var MEANING = { good: "good", care: "good, with a remark", bad: "not used" };
  function byId(id) { return document.getElementById(id); }
  function made(tag, text, name) {
    var e = document.createElement(tag);
    e.textContent = text;
    if (name) { e.className = name; }
    return e;
  }
  function replace(id, children) { byId(id).replaceChildren.apply(byId(id), children); }
  function set(id, text) { if (byId(id).textContent !== text) { byId(id).textContent = text; } }
  function repeated(sign, count) { return new Array(Math.max(count, 0) + 1).join(sign); }
  function point(p, state) {
    var e = made("li", "", p.point === state.next ? "now" : p.done ? "done" : "");
    e.append(made("div", (p.done ? "✓ " : "") + p.point, "name"));
    var dots = made("div", repeated("●", Math.min(p.good, p.wanted)) + repeated("○", p.wanted - p.good), "dots");
    dots.setAttribute("role", "img");
    dots.setAttribute("aria-label", p.good + " of " + p.wanted + " good hits");
    e.append(dots);
    e.append(made("div", p.good + " of " + p.wanted + (p.coherence ? ", coherence " + p.coherence : ""), p.low ? "low" : "sub"));
    if (p.coherence) { e.title = "Lowest median coherence over the band: " + p.channel; }
    return e;
  }
  function file(f) {
    var e = made("tr", "", f.mark), mark = made("td", MARKS[f.mark], "mark");
    mark.title = MEANING[f.mark];
    e.append(mark, made("td", f.file), made("td", f.point), made("td", f.force, "n"), made("td", f.what), made("td", f.at, "n"));
    return e;
  }
  function headline(state) {
    if (state.trouble) { return state.trouble; }
    if (state.done) { return "All points are done"; }
    if (!state.next) { return "Strike a point"; }
    var p = state.points.filter(function (x) { return x.point === state.next; })[0];
    return "Strike " + state.next + (p ? " (hit " + (p.good + 1) + " of " + p.wanted + ")" : "");
  }
  function follow(state) {
    var last = state.files[0];
    set("next", headline(state));
    set("last", last ? MARKS[last.mark] + " " + last.file + ": " + (last.what || [last.point, last.force].filter(Boolean).join(", ")) : "No file yet.");
    byId("now").className = "band " + (state.trouble ? "bad" : last ? last.mark : "");
    replace("points", state.points.map(function (p) { return point(p, state); }));
    replace("files", state.files.map(file));
    set("count", state.count ? state.count + " judged, " + state.good + " of use" : "");
    byId("missing").hidden = !state.missing.length;
    set("missing", state.missing.length ? "Listed in test.toml, but not there yet: " + state.missing.join(", ") : "");
    document.documentElement.dataset.ready = "1";
  }
  var events = new EventSource("/events");
  events.onmessage = function (e) { follow(JSON.parse(e.data)); };
  events.onerror = function () { set("next", "The server does not answer: has 'ema view' ended?"); byId("now").className = "band bad"; };
}());
