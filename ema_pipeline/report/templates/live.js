/* The live page: follows the server's state, and asks it for actions. */
(function () {
  "use strict";
  var shown = 0, loading = false, figures = "", measured = "", state = null;
  function byId(id) { return document.getElementById(id); }
  function json(url) { return fetch(url, { credentials: "same-origin" }).then(function (r) { if (!r.ok) { throw new Error(r.status); } return r.json(); }); }
  function ask(verb, label) {
    return fetch("/action", { method: "POST", credentials: "same-origin", headers: { "Content-Type": "application/json" }, body: JSON.stringify({ verb: verb, label: label || "" }) })
      .then(function (r) { return r.ok ? null : r.json().then(function (e) { byId("status").textContent = e.error; }); },
        function () { byId("status").textContent = "The server did not take that: has 'ema view' ended?"; });
  }
  /* What was typed or focused stays where the part of the page is made anew. */
  function replaceParts(parts) {
    var focus = document.activeElement && document.activeElement.dataset ? document.activeElement.dataset.label : null;
    Object.keys(parts).forEach(function (id) { var e = byId(id); if (e) { e.innerHTML = parts[id]; } });
    focused(focus);
  }
  function update() {
    if (loading || state.version === shown) { return; }
    loading = true;
    json("/model").then(function (model) {
      if (figures !== model.figures.join() || measured !== model.measured) { again(); return; }
      shown = model.version;
      replaceParts(model.parts);
      EmaPage.newModel(model.data);
      buttons();
      loading = false;
      document.documentElement.dataset.version = String(shown);
      update();
    }, function () { loading = false; });
  }
  /* Other measurements: the whole page is made anew, and what was focused stays so. */
  function again() {
    var focus = document.activeElement && document.activeElement.dataset ? document.activeElement.dataset.label : "";
    sessionStorage.setItem("focus", focus || "");
    location.reload();
  }
  function focused(label) {
    document.querySelectorAll("button.act").forEach(function (b) { if (label && b.dataset.label === label) { b.focus(); } });
  }
  function buttons() {
    var busy = !!state.job;
    document.querySelectorAll("button.act").forEach(function (b) { b.disabled = busy && b.id !== "cancel"; });
    if (byId("undo")) { byId("undo").disabled = !state.undo; }
    byId("cancel").hidden = byId("progress").hidden = !busy;
    byId("live").classList.toggle("busy", busy);
  }
  function follow(now) {
    state = now;
    var job = now.job, status = byId("status"), text = now.message;
    if (job) {
      text = { add: "Adding ", remove: "Removing ", diagnose: "Diagnosing ", exclude: "Excluding ", include: "Including " }[job.verb.split("_")[0]] + job.label + ": " + job.stage + (job.text ? ", " + job.text : "") + ", " + Math.round(job.seconds) + " s";
      byId("progress").value = job.done;
      if (now.preview && now.preview.length) {
        var first = now.preview[0], end = now.preview[now.preview.length - 1];
        text = "Error " + first.error.toPrecision(3) + " → " + end.error.toPrecision(3) + (end.held === null ? "" : ", held out " + end.held.toPrecision(3)) + "; " + job.stage + " …";
      }
    }
    if (status.textContent !== text) { status.textContent = text; }
    byId("count").textContent = String(now.commands.length);
    byId("commands").textContent = now.commands.join("\n");
    buttons();
    update();
  }
  function wanted(field, text) { byId("status").textContent = text; field.focus(); }
  document.addEventListener("click", function (e) {
    var b = e.target.closest("button.act");
    if (b && b.dataset.verb) { ask(b.dataset.verb, b.dataset.label); }
  });
  if (byId("add-form")) {
    byId("add-form").addEventListener("submit", function (e) {
      var field = byId("add-label"), first = document.querySelector("#addable option");
      e.preventDefault();
      if (field.value.trim()) { ask("add", field.value.trim()); field.value = ""; return; }
      wanted(field, "Type an effect and its place" + (first ? ", e.g. " + first.value : "") + ", or choose one from the list of the field.");
    });
  }
  if (byId("include-form")) {
    document.addEventListener("pole", function (e) { byId("include-hertz").value = Number(e.detail.toPrecision(7)); byId("include-hertz").focus({ preventScroll: true }); });
    byId("include-form").addEventListener("submit", function (e) {
      var hertz = byId("include-hertz").value.trim();
      e.preventDefault();
      if (!hertz) { wanted(byId("include-hertz"), "Type the frequency of a mode in Hz, or click a pole of the chart."); return; }
      if (EmaPage.configuration()) { ask("include_mode", EmaPage.configuration() + ":" + hertz); byId("include-hertz").value = ""; }
    });
  }
  byId("copy-commands").addEventListener("click", function (e) { EmaPage.copied(e.target, state.commands.join("\n") + "\n"); });
  Promise.all([json("/measured"), json("/model")]).then(function (got) {
    shown = got[1].version;
    figures = got[1].figures.join();
    measured = got[1].measured;
    EmaPage.start({ items: got[0].items, measured: got[0].measured, model: got[1].data });
    document.documentElement.dataset.version = String(shown);
    focused(sessionStorage.getItem("focus"));
    sessionStorage.removeItem("focus");
    var events = new EventSource("/events");
    events.onmessage = function (e) { follow(JSON.parse(e.data)); };
    events.onerror = function () { byId("status").textContent = "The server does not answer: has 'ema view' ended?"; };
  });
}());
