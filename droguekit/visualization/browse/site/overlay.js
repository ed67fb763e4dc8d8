/* One eye's image with what the labels and an estimate say, as SVG in the image's own pixel coordinates. */
"use strict";

(function () {
  const SVG = "http://www.w3.org/2000/svg";
  // Half the length of a cross over the visible width.
  const ARM_SHARE = 0.009;
  // Side of the zoomed view over that of the drogue's box.
  const MARGIN = 1.5;
  const SMALLEST_VIEW_PX = 24;

  /** A new SVG element with attributes. */
  function element(name, attributes) {
    const made = document.createElementNS(SVG, name);
    for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
    return made;
  }

  /** A group for one layer, named by its class. */
  function layer(name) {
    return element("g", { class: `layer ${name}` });
  }

  function box(xywh, kind) {
    const [x, y, width, height] = xywh;
    return element("rect", { class: kind, x, y, width, height });
  }

  /** An upright or diagonal cross at an image point, of constant size on the screen. */
  function cross(x, y, arm, kind, name) {
    const path = kind.startsWith("measured") ? "M-1-1L1 1M-1 1L1-1" : "M-1 0H1M0-1V1";
    const made = element("path", { class: kind, d: path, transform: `translate(${x} ${y}) scale(${arm})` });
    made.dataset.name = name;
    return made;
  }

  function outline(rig, eye, pose, rings) {
    return rings
      .map((ring) => [ring.kind, droguekit.ringImage(rig, eye, pose, ring)])
      .filter(([, corners]) => corners !== null)
      .map(([kind, corners]) => {
        const points = corners.map(([x, y]) => `${x.toFixed(4)},${y.toFixed(4)}`).join(" ");
        return element("polygon", { class: kind, points });
      });
  }

  /** Layers of an eye, by name. */
  function layersOf(catalogue, labels, eye, estimate, arm) {
    const view = labels[eye];
    const groups = {};
    for (const name of droguekit.LAYERS) groups[name] = layer(name);
    if (view.box_full_px) groups.box.append(box(view.box_full_px, "full"));
    if (view.box_visible_px) groups.box.append(box(view.box_visible_px, "visible"));
    view.markers.forEach(([x, y, seen], index) => {
      groups.markers.append(cross(x, y, arm, seen > 0 ? "seen" : "unseen", `marker ${index}`));
    });
    view.board_corners_px.forEach(([x, y], index) => {
      groups.markers.append(cross(x, y, arm, "seen", `corner ${index}`));
    });
    if (view.hub) groups.hub.append(cross(view.hub[0], view.hub[1], arm, view.hub[2] > 0 ? "seen" : "unseen", "hub"));
    const rings = catalogue.drogues[labels.drogue];
    if (labels.pose) groups.truth.append(...outline(catalogue.rig, eye, labels.pose, rings));
    if (estimate && estimate.pose) groups.estimate.append(...outline(catalogue.rig, eye, estimate.pose, rings));
    for (const [of, name, x, y, used] of estimate ? estimate.centroids : []) {
      if (of === eye) groups.centroids.append(cross(x, y, arm, used ? "measured" : "measured unused", name));
    }
    return groups;
  }

  /** The box around the drogue in an eye's image, else around an estimate, else null. */
  droguekit.surroundings = function (labels, eye, estimate) {
    const view = labels[eye];
    if (view.box_visible_px || view.box_full_px) return view.box_visible_px || view.box_full_px;
    if (!estimate || !estimate.pose) return null;
    const { rig, drogues } = droguekit.catalogue;
    const corners = droguekit.ringImage(rig, eye, estimate.pose, drogues[labels.drogue][0]);
    if (!corners) return null;
    const [low, high] = [Math.min, Math.max].map((end) => [0, 1].map((axis) => end(...corners.map((xy) => xy[axis]))));
    return [low[0], low[1], high[0] - low[0], high[1] - low[1]];
  };

  /** The part of the image that is shown: all of it, or the surroundings of a box. */
  function viewBox(catalogue, xywh) {
    const [width, height] = [catalogue.width_px, catalogue.height_px];
    if (!xywh) return [-0.5, -0.5, width, height];
    const wide = Math.max(SMALLEST_VIEW_PX, MARGIN * Math.max(xywh[2], (xywh[3] * width) / height));
    const high = (wide * height) / width;
    return [xywh[0] + xywh[2] / 2 - wide / 2, xywh[1] + xywh[3] / 2 - high / 2, wide, high];
  }

  droguekit.LAYERS = ["box", "truth", "estimate", "markers", "hub", "centroids"];

  /**
   * Draw an eye's image and its overlay.
   * @param svg      the element to fill
   * @param shown    {row, labels, eye, estimate, zoomed, hidden: names of the layers that are not drawn, complain: is
   *                 told of an image that cannot be shown}
   */
  droguekit.drawEye = function (svg, shown) {
    const { row, labels, eye, estimate, zoomed, hidden, complain } = shown;
    const catalogue = droguekit.catalogue;
    const around = droguekit.surroundings(labels, eye, estimate);
    const seen = viewBox(catalogue, zoomed ? around : null);
    svg.setAttribute("viewBox", seen.join(" "));
    svg.setAttribute("aria-label", `Frame ${row.frame}, ${eye} eye`);
    svg.classList.toggle("zoomed", Boolean(zoomed && around));
    const href = `pictures/${row.picture}-${eye}.jpg`;
    const image = element("image", {
      href,
      x: -0.5,
      y: -0.5,
      width: catalogue.width_px,
      height: catalogue.height_px,
      preserveAspectRatio: "none",
    });
    image.addEventListener("error", () => image.isConnected && complain(`${href} cannot be shown.`));
    const groups = layersOf(catalogue, labels, eye, estimate, ARM_SHARE * seen[2]);
    svg.replaceChildren(image, ...droguekit.LAYERS.filter((name) => !hidden.has(name)).map((name) => groups[name]));
  };
})();
