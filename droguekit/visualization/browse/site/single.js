/* One pair, large: both eyes with their overlay, and its tables. */
"use strict";

(function () {
  const AT_MOST_KEPT = 50;
  const received = new Map();
  const byId = (id) => document.getElementById(id);
  const hidden = new Set();
  let zoomed = false;
  let current = null;
  let wanted = null;
  const faults = new Set();
  const NOTHING_SEEN = { box_full_px: null, box_visible_px: null, markers: [], hub: null, board_corners_px: [] };
  const NO_LABELS = {
    pose: null, drogue: null, left: NOTHING_SEEN, right: NOTHING_SEEN, conditions: [], estimates: [],
  };

  /** Called by a pair's own script with its labels. */
  droguekit.receive = function (name, labels) {
    received.set(name, labels);
    if (received.size > AT_MOST_KEPT) received.delete(received.keys().next().value);
  };

  /** Load a pair's labels; a page from the file system can read files only as scripts. */
  function load(name) {
    if (received.has(name)) return Promise.resolve(received.get(name));
    return new Promise((resolve, reject) => {
      const script = document.createElement("script");
      const end = (fault) => {
        script.remove();
        if (received.has(name)) resolve(received.get(name));
        else reject(new Error(`${script.getAttribute("src")} ${fault}`));
      };
      script.src = `data/${name}.js`;
      script.onload = () => end("holds no labels of it");
      script.onerror = () => end("is missing");
      document.head.append(script);
    });
  }

  function complain(fault) {
    faults.add(fault);
    byId("fault").textContent = `${[...faults].join(" ")} Write the page again.`;
    byId("fault").hidden = false;
  }

  function cell(name, text, span) {
    const made = document.createElement(name);
    made.textContent = text;
    if (name === "th") made.scope = "row";
    if (span) made.colSpan = span;
    return made;
  }

  function fill(id, rows) {
    const body = byId(id).tBodies[0];
    body.replaceChildren(
      ...rows.map((cells) => {
        const line = document.createElement("tr");
        line.append(...cells);
        return line;
      }),
    );
    byId(id).hidden = rows.length === 0;
  }

  /** Three significant digits and never an exponent, as the reports write numbers. */
  function threeDigits(value) {
    const rounded = value.toExponential(2);
    const decimals = Math.max(0, 2 - Number(rounded.split("e")[1]));
    return Number(rounded).toFixed(Math.min(decimals, 100)).replace("-", "\u2212");
  }

  function estimateCells(estimate) {
    const name = cell("th", estimate.method);
    if (!estimate.pose) return [name, cell("td", `no fix: ${estimate.reason}`, 3)];
    if (!estimate.error) {
      const what = droguekit.catalogue.is_blind ? "a fix" : "a fix and no drogue there,";
      return [name, cell("td", `${what} at ${estimate.pose[11].toFixed(2)}\u00a0m`, 3)];
    }
    const [position, pitch, yaw] = estimate.error;
    const degrees = (value) => `${threeDigits(value)}°`;
    return [name, cell("td", droguekit.millimetres(position)), cell("td", degrees(pitch)), cell("td", degrees(yaw))];
  }

  function featureRows(labels) {
    const pairs = labels.left.markers.map((left, index) => [`marker ${index}`, left, labels.right.markers[index]]);
    if (labels.left.hub && labels.right.hub) pairs.push(["hub", labels.left.hub, labels.right.hub]);
    return pairs.map(([name, ...eyes]) => [
      cell("th", name),
      ...eyes.flatMap(([x, y, seen]) => [
        cell("td", `${x.toFixed(2)}, ${y.toFixed(2)}`),
        cell("td", `${Math.round(100 * seen)} %`),
      ]),
    ]);
  }

  function draw() {
    if (current === null) return;
    const { row, labels } = current;
    const method = byId("layers").elements.drawn.value;
    const estimate = labels.estimates.find((one) => one.method === method);
    for (const eye of ["left", "right"]) {
      droguekit.drawEye(byId(eye), { row, labels, eye, estimate, zoomed, hidden, complain });
    }
    byId("zoom").disabled = !["left", "right"].some((eye) => droguekit.surroundings(labels, eye, estimate));
    byId("zoom").setAttribute("aria-pressed", String(zoomed));
  }

  /** Show a pair; `place` says where it stands in the list, and the estimate of `method` is drawn. */
  droguekit.showPair = async function (row, place, method) {
    wanted = row;
    byId("title").textContent = droguekit.titleOf(row) + place;
    byId("layers").elements.drawn.value = method ?? "";
    let labels, fault;
    try {
      labels = await load(row.labels);
    } catch (error) {
      labels = NO_LABELS;
      fault = `This pair's labels cannot be shown: ${error.message}.`;
    }
    if (wanted !== row) return; // another pair was opened meanwhile
    faults.clear();
    byId("fault").hidden = true;
    if (fault) complain(fault);
    current = { row, labels };
    fill("conditions", labels.conditions.map(([name, value]) => [cell("th", name), cell("td", value)]));
    fill("estimates", labels.estimates.map(estimateCells));
    fill("features", featureRows(labels));
    draw();
  };

  /** A pair in a few words. */
  droguekit.titleOf = function (row) {
    if (droguekit.catalogue.is_blind) return `Frame ${row.frame}`;
    const distance = row.distance_m === null ? "no drogue" : `${row.distance_m.toFixed(2)}\u00a0m`;
    return `Frame ${row.frame}, ${row.family}, ${distance}`;
  };

  droguekit.millimetres = function (error_mm) {
    return `${threeDigits(error_mm)}\u00a0mm`;
  };

  droguekit.toggleZoom = function () {
    zoomed = !zoomed;
    draw();
  };

  byId("layers").addEventListener("change", () => {
    for (const input of byId("layers").querySelectorAll("input")) {
      if (input.checked) hidden.delete(input.name);
      else hidden.add(input.name);
    }
    draw();
  });
  for (const input of byId("layers").querySelectorAll("input")) if (!input.checked) hidden.add(input.name);
  byId("zoom").addEventListener("click", droguekit.toggleZoom);
})();
