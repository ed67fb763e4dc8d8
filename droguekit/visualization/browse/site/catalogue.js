/* Which pairs are shown and in which order: filters over the catalogue, and their form in the page's address. */
"use strict";

(function () {
  const catalogue = droguekit.catalogue;

  // Tests of rows by the name of a filter, whose value is read once for all rows.
  const BY = {
    near: (value) => (row) => row.distance_m !== null && row.distance_m >= Number(value),
    far: (value) => (row) => row.distance_m !== null && row.distance_m <= Number(value),
    drogue: (value) => (row) => drogueOf(row) === value,
    family: (value) => (row) => row.family === value,
    split: (value) => (row) => row.split === value,
    sequence: (value) => (row) => String(row.sequence) === value,
    light: (value) => (row) => row.light === value,
    text: (value) => {
      const words = value.toLowerCase().split(/\s+/).filter(Boolean);
      const numbers = words.filter((word) => /^\d+$/.test(word));
      const others = words.filter((word) => !numbers.includes(word));
      const isIn = (row) => (number) => String(row.frame) === number || row.text.split(" ").includes(number);
      return (row) => others.every((word) => row.text.includes(word)) && numbers.every(isIn(row));
    },
    result: (value, state) => (row) => kindOf(droguekit.resultOf(row, state)) === value,
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
    const names = Object.keys(BY).filter((name) => state[name]);
    const tests = names.map((name) => BY[name](state[name], state));
    const rows = catalogue.rows.filter((row) => tests.every((test) => test(row)));
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
