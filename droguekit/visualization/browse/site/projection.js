/* Where the images show what a pose says. Frames and pixels are those of the dataset: x right, y down, z forward, and
   pixel (0, 0) is the centre of the top-left one. Every later script adds to `droguekit`. */
"use strict";
var droguekit = {};

(function () {
  // Circles nearer to the camera's plane than this are not drawn. [m]
  const NEAREST_M = 0.05;

  /** A point of the drogue in the left camera's frame. [m] `pose` holds the upper three rows of the matrix. */
  function placed(pose, point) {
    const [x, y, z] = point;
    return [0, 4, 8].map((row) => pose[row] * x + pose[row + 1] * y + pose[row + 2] * z + pose[row + 3]);
  }

  /** Pixel of an ideal camera for a direction with z = 1. [px] */
  function pixel(camera, x, y) {
    return [camera.fx_px * x + camera.cx_px, camera.fy_px * y + camera.cy_px];
  }

  /** Point on a sensor that is tilted about both axes [rad], of one on a sensor across the axis. */
  function tilted(x, y, tauX, tauY) {
    const [cosX, sinX, cosY, sinY] = [Math.cos(tauX), Math.sin(tauX), Math.cos(tauY), Math.sin(tauY)];
    // The rotation about x, then the one about y.
    const turned = [
      cosY * x + sinX * sinY * y - cosX * sinY,
      cosX * y + sinX,
      sinY * x - sinX * cosY * y + cosX * cosY,
    ];
    const [alongX, alongY, depth] = [-cosX * sinY, sinX, cosX * cosY];
    return [(depth * turned[0]) / turned[2] - alongX, (depth * turned[1]) / turned[2] - alongY];
  }

  /** Pixel of a distorting lens for a direction, with z = 1, in the rectified rig (OpenCV's models). [px]
   * What lies beyond the lens's field is drawn at its edge: its polynomial may fold back into the image there. */
  function throughLens(lens, xIdeal, yIdeal) {
    const [low, high] = lens.field;
    const [a, b] = [xIdeal, yIdeal].map((value, axis) => Math.min(Math.max(value, low[axis]), high[axis]));
    const turn = lens.real_from_ideal;
    const [u, v, w] = [0, 3, 6].map((row) => turn[row] * a + turn[row + 1] * b + turn[row + 2]);
    const [x, y] = [u / w, v / w];
    const [k1, k2, p1, p2, k3, k4 = 0, k5 = 0, k6 = 0, s1 = 0, s2 = 0, s3 = 0, s4 = 0, tauX = 0, tauY = 0] =
      lens.distortion;
    const r2 = x * x + y * y;
    const radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)));
    const seenX = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x) + r2 * (s1 + r2 * s2);
    const seenY = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y + r2 * (s3 + r2 * s4);
    return pixel(lens.camera, ...tilted(seenX, seenY, tauX, tauY));
  }

  /** Pixel of a point of the left camera's frame [m] in an eye, "left" or "right". [px] */
  function imageOf(rig, eye, point) {
    const [x, y] = [(point[0] - (eye === "right" ? rig.baseline_m : 0)) / point[2], point[1] / point[2]];
    if (rig.lenses === null) return pixel(rig.camera, x, y);
    return throughLens(rig.lenses[eye === "left" ? 0 : 1], x, y);
  }

  /** Corners of a ring's image in an eye [px], or null where it reaches behind the eye. */
  droguekit.ringImage = function (rig, eye, pose, ring) {
    const corners = [];
    for (let k = 0; k < ring.points; k++) {
      const angle = (2 * Math.PI * k) / ring.points;
      const [x, y, z] = ring.center_m;
      const at = [x + ring.radius_m * Math.cos(angle), y + ring.radius_m * Math.sin(angle), z];
      const point = placed(pose, at);
      if (point[2] <= NEAREST_M) return null;
      corners.push(imageOf(rig, eye, point));
    }
    return corners;
  };
})();
