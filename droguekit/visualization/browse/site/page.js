/* The page: its filters, its list of pairs in parts, and the keys. The address mirrors the state, so links work. */
"use strict";

(function () {
  const PER_PAGE = 60;
  const catalogue = droguekit.catalogue;
  const byId = (id) => document.getElementById(id);
  const form = byId("filters");
  let state = {};
  let rows = [];
  // The address does not say yet which pair is shown.
  let isLate = false;

  function addOptions(select, values) {
    for (const value of values) select.add(new Option(String(value), String(value)));
  }

  /** Fill the filters with values of the dataset; hide filters that all pairs pass. */
  function fillFilters() {
    for (const column of ["family", "split", "sequence", "light"]) {
      const values = droguekit.valuesOf(column);
      addOptions(form.elements[column], values);
      form.elements[column].parentElement.hidden = values.length < 2;
    }
    for (const name of ["near", "far", "drogue"]) form.elements[name].parentElement.hidden = catalogue.is_blind;
    const { methods } = catalogue;
    addOptions(form.elements.method, methods);
    form.elements.method.parentElement.hidden = methods.length < 2;
    form.elements.result.parentElement.hidden = methods.length === 0;
    form.elements.order.querySelector("[value=error]").hidden = methods.length === 0 || catalogue.is_blind;
    const layers = byId("layers");
    addOptions(layers.elements.drawn, methods);
    byId("drawn-method").hidden = methods.length < 2;
    for (const name of ["box", "markers", "hub", "truth"]) layers.querySelector(`.${name}`).hidden = catalogue.is_blind;
    for (const name of ["estimate", "centroids"]) layers.querySelector(`.${name}`).hidden = methods.length === 0;
  }

  function showFilters() {
    for (const field of form.elements) {
      if (!field.name) continue;
      const wanted = state[field.name] ?? (field.name === "method" ? (catalogue.methods[0] ?? "") : "");
      // Setting a field's value, even to the same, moves its caret to the start.
      if (field.value !== wanted) field.value = wanted;
    }
  }

  /** The left eye's small picture with the visible box of the drogue. */
  function tile(row) {
    const item = document.createElement("li");
    const link = document.createElement("a");
    link.href = droguekit.addressOf({ ...state, frame: row.frame });
    link.dataset.frame = row.frame;
    const frame = document.createElement("span");
    frame.className = "picture";
    const image = new Image(catalogue.width_px, catalogue.height_px);
    image.loading = "lazy";
    image.decoding = "async";
    image.alt = "";
    image.src = `pictures/${row.picture}-small.jpg`;
    frame.append(image);
    if (row.box_px) frame.append(mark(row.box_px));
    const caption = document.createElement("span");
    caption.textContent = droguekit.titleOf(row) + errorOf(row);
    link.append(frame, caption);
    item.append(link);
    return item;
  }

  function mark([x, y, width, height]) {
    const box = document.createElement("i");
    // In percent of the picture, whose corner is half a pixel before the first pixel's centre.
    box.style.left = `${(100 * (x + 0.5)) / catalogue.width_px}%`;
    box.style.top = `${(100 * (y + 0.5)) / catalogue.height_px}%`;
    box.style.width = `${(100 * width) / catalogue.width_px}%`;
    box.style.height = `${(100 * height) / catalogue.height_px}%`;
    return box;
  }

  function errorOf(row) {
    if (catalogue.methods.length === 0) return "";
    const result = droguekit.resultOf(row, state);
    if (result === null) return "";
    if (typeof result === "number") return `, ${droguekit.millimetres(result)} off`;
    return result === "fix" && !catalogue.is_blind ? ", false fix" : `, ${result}`;
  }

  /** The number of pages, and the state's page. */
  function pages() {
    const last = Math.max(1, Math.ceil(rows.length / PER_PAGE));
    return { last, page: Math.min(last, Math.max(1, Math.trunc(Number(state.page)) || 1)) };
  }

  function showAll() {
    const { last, page } = pages();
    byId("count").textContent = `${rows.length} of ${catalogue.rows.length} pairs`;
    byId("page-place").textContent = `Page ${page} of ${last}`;
    byId("page-back").disabled = page === 1;
    byId("page-on").disabled = page === last;
    byId("pages").hidden = last === 1;
    byId("tiles").replaceChildren(...rows.slice((page - 1) * PER_PAGE, page * PER_PAGE).map(tile));
  }

  /** Rows before and after the shown one. */
  function neighbours() {
    const place = rows.findIndex((row) => String(row.frame) === state.frame);
    return { place, before: rows[place - 1], after: place < 0 ? rows[0] : rows[place + 1] };
  }

  function showOne() {
    const row = catalogue.rows.find((one) => String(one.frame) === state.frame);
    if (!row) {
      delete state.frame;
      mirror();
      return false;
    }
    const { place, before, after } = neighbours();
    byId("previous").disabled = !before;
    byId("next").disabled = !after;
    byId("back").href = droguekit.addressOf({ ...state, frame: undefined, page: pageOf(place) });
    const where = place < 0 ? " (not among the filtered ones)" : ` (${place + 1} of ${rows.length})`;
    droguekit.showPair(row, where, droguekit.methodOf(state));
    return true;
  }

  function pageOf(place) {
    const page = Math.floor(Math.max(0, place) / PER_PAGE) + 1;
    return page > 1 ? page : undefined;
  }

  /** Show a state and make it the page's. */
  function show(next) {
    const before = state.frame;
    state = next;
    rows = droguekit.chosen(state);
    const single = state.frame !== undefined && showOne();
    byId("one").hidden = !single;
    byId("all").hidden = single;
    showFilters();
    showAll();
    // Screen readers and keyboard users continue at the picture, or where it was.
    if (single && before === undefined) byId("title").focus();
    if (!single && before !== undefined) document.querySelector(`[data-frame="${Number(before)}"]`)?.focus();
  }

  /** Change the state; larger steps get an entry in the browser's history. */
  function change(changes, keep) {
    const address = droguekit.addressOf({ ...state, ...changes });
    if (keep) location.hash = address;
    else {
      show(droguekit.stateOf(address));
      mirror();
    }
  }

  /** Write the state into the address. Browsers block frequent writes, so it is never read back. */
  function mirror() {
    isLate = false;
    try {
      history.replaceState(null, "", droguekit.addressOf(state));
    } catch {
      // Safari throws; the next change writes it.
    }
  }

  /** Show another pair; while a key is held, the address is written only after its release. */
  function step(row, isHeld) {
    if (!row) return;
    show({ ...state, frame: String(row.frame) });
    if (isHeld) isLate = true;
    else mirror();
  }

  form.addEventListener("input", ({ target }) => change({ [target.name]: target.value, page: undefined }, false));
  form.addEventListener("submit", (event) => event.preventDefault());
  form.addEventListener("reset", (event) => {
    event.preventDefault();
    show({});
    mirror();
  });
  byId("page-back").addEventListener("click", () => change({ page: pages().page - 1 }, true));
  byId("page-on").addEventListener("click", () => change({ page: pages().page + 1 }, true));
  byId("page-number").addEventListener("change", ({ target }) => {
    if (target.value) change({ page: target.value }, true);
    target.value = "";
  });
  byId("previous").addEventListener("click", () => step(neighbours().before));
  byId("next").addEventListener("click", () => step(neighbours().after));
  byId("layers").elements.drawn.addEventListener("change", (event) => change({ method: event.target.value }, false));
  document.addEventListener("keydown", (event) => {
    const typing = event.target.matches("input:not([type=checkbox]), select, textarea");
    if (byId("one").hidden || typing || event.altKey || event.ctrlKey || event.metaKey) return;
    if (event.key === "ArrowLeft") step(neighbours().before, event.repeat);
    else if (event.key === "ArrowRight") step(neighbours().after, event.repeat);
    else if (event.key === "z" && !byId("zoom").disabled) droguekit.toggleZoom();
    else if (event.key === "Escape") location.hash = byId("back").getAttribute("href");
    else return;
    event.preventDefault();
  });
  document.addEventListener("keyup", () => isLate && mirror());
  window.addEventListener("hashchange", () => show(droguekit.stateOf(location.hash)));
  fillFilters();
  show(droguekit.stateOf(location.hash));
})();
