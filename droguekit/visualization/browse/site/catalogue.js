/* Which pairs are shown and in which order: filters over the catalogue, and their form in the page's address. */
"use strict";

(function () {
  const catalogue = droguekit.catalogue;

  const BY = {
    near: (row, value) => row.distance_m !== null && row.distance_m >= Number(value),
    far: (row, value) => row.distance_m !== null && row.distance_m <= Number(value),
    drogue: (row, value) => drogueOf(row) === value,
    family: (row, value) => row.family === value,
    split: (row, value) => row.split === value,
    sequence: (row, value) => String(row.sequence) === value,
    light: (row, value) => row.light === value,
    text: (row, value) => {
      const text = `${row.frame} ${row.text}`;
      const words = text.split(" ");
      const found = (word) => (/^\d+$/.test(word) ? words.includes(word) : text.includes(word));
      return value.toLowerCase().split(/\s+/).filter(Boolean).every(found);
    },
    result: (row, value, state) => kindOf(droguekit.resultOf(row, state)) === value,
  };

  const ORDERS = {
    near: (row) => row.distance_m ?? Infinity,
    far: (row) => -(row.distance_m ?? -Infinity),
    // A fix without a drogue counts as the largest error.
    error: (row, state) => {
      const result = droguekit.resultOf(row, state);
      if (result === "fix") return -Infinity;
      return typeof result === "number" ? -result : Infinity;
    },
  };

  function kindOf(result) {
    if (result === null) return "missing";
    return result === "no fix" ? "none" : "fix";
  }

  function drogueOf(row) {
    if (row.distance_m === null) return "none";
    return row.box_px === null ? "hidden" : "seen";
  }

  /** The chosen method, or the first one. */
  droguekit.methodOf = function (state) {
    return catalogue.methods.includes(state.method) ? state.method : catalogue.methods[0];
  };

  /** That method's result for a pair: its error [mm], "fix" without truth, "no fix", or null without an estimate. */
  droguekit.resultOf = function (row, state) {
    return row.estimates[catalogue.methods.indexOf(droguekit.methodOf(state))];
  };

  /** Rows that pass the filters of a state, in its order. */
  droguekit.chosen = function (state) {
    const tests = Object.entries(BY).filter(([name]) => state[name]);
    const rows = catalogue.rows.filter((row) => tests.every(([name, test]) => test(row, state[name], state)));
    if (!Object.hasOwn(ORDERS, state.order ?? "")) return rows;
    const key = ORDERS[state.order];
    const keyed = rows.map((row) => [key(row, state), row]);
    // Infinite keys are equal, but their difference is not a number.
    return keyed.sort((a, b) => (a[0] < b[0] ? -1 : a[0] > b[0] ? 1 : a[1].frame - b[1].frame)).map(([, row]) => row);
  };

  /** Values of a column that occur, sorted. */
  droguekit.valuesOf = function (column) {
    const values = new Set(catalogue.rows.map((row) => row[column]).filter((value) => value !== null));
    if (column === "light") return catalogue.lights.filter((light) => values.has(light));
    return [...values].sort((a, b) => (typeof a === "number" ? a - b : a < b ? -1 : 1));
  };

  /** The state that an address holds, in strings. */
  droguekit.stateOf = function (address) {
    return Object.fromEntries(new URLSearchParams(address.slice(1)));
  };

  /** The address of a state. */
  droguekit.addressOf = function (state) {
    const entries = Object.entries(state).filter(([, value]) => value !== "" && value !== undefined);
    return "#" + new URLSearchParams(entries).toString();
  };
})();
