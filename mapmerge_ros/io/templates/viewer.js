'use strict';
// The scenes of a report: points, lines and ellipsoids on a 2D canvas, turned by hand.
// Points are written pixel by pixel with a depth buffer: no WebGL, the same picture everywhere.
// Frame of a scene: x right, y away, z up; the map has radius 1 (mapmerge_ros/io/viewpoint.py).

const SHADES = 6;               // of a colour, from near to far
const SHARED = 0x8000, LANDMARK = 0x4000, OWNER = 0x3fff;
const DISTANCE = 4;             // of the eye from the middle: a mild perspective
const ELLIPSOID = 2.8;          // standard deviations: 95 % in space, sqrt of chi2(3)
const FINE = 2, COARSE = 1;     // drawn pixels for one of the page, at rest and when it is slow
const SMALL_PX = 9;             // arrows shorter than this are ringed
const SLOW_MS = 45, MORPH_MS = 900;
const P_LEVELS = [1e-3, 1e-6, 1e-12];

const mix = (a, b, t) => a + (b - a) * t;
const between = (low, value, high) => Math.min(Math.max(value, low), high);
const words = text => new Uint16Array(Uint8Array.from(atob(text), c => c.charCodeAt(0)).buffer);
const css = name => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
const rgb = hex => [1, 3, 5].map(k => parseInt(hex.slice(k, k + 2), 16));

function unpack({low, step, data}) {
  return Float32Array.from(words(data), (word, i) => low[i % 3] + step[i % 3] * word);
}

/** Looks at a target from a turn and a tilt; zooming changes the lens, not the place. */
class Camera {
  constructor(target, zoom) {
    this.home = {turn: -0.35, tilt: 0.95, zoom, target};
    this.reset();
  }

  reset() { Object.assign(this, this.home, {target: [...this.home.target]}); }

  aim(width, height) {
    const [sin, cos, up, level] =
      [Math.sin(this.turn), Math.cos(this.turn), Math.sin(this.tilt), Math.cos(this.tilt)];
    this.right = [cos, sin, 0];
    this.above = [-sin * up, cos * up, level];
    this.ahead = [-sin * level, cos * level, -up];
    this.focal = 1.65 * this.zoom * Math.min(width, 1.45 * height);
    this.middle = [width / 2, 0.46 * height];  // what is near looks larger
  }

  /** Pixel x, y and depth of a point. */
  project(point) {
    const [x, y, z] = point.map((value, k) => value - this.target[k]);
    const along = axis => axis[0] * x + axis[1] * y + axis[2] * z;
    const depth = DISTANCE + along(this.ahead);
    const scale = this.focal / Math.max(depth, 0.1);
    return [this.middle[0] + scale * along(this.right),
            this.middle[1] - scale * along(this.above), depth];
  }

  orbit(dx, dy) {
    this.turn -= dx;
    this.tilt = between(-Math.PI / 2, this.tilt + dy, Math.PI / 2);
  }

  /** Move so that the target follows a finger by dx, dy pixels of the page. */
  pan(dx, dy) {
    const unit = DISTANCE / this.focal;
    this.target = this.target.map(
      (value, k) => value - unit * (dx * this.right[k] - dy * this.above[k]));
  }

  magnify(factor) { this.zoom = between(0.2, this.zoom * factor, 400); }
}

/** Writes points into pixels, the nearest one on top. */
class Splatter {
  constructor() { this.canvas = document.createElement('canvas'); }

  resize(width, height) {
    if (this.canvas.width === width && this.canvas.height === height) return;
    Object.assign(this.canvas, {width, height});
    this.context = this.canvas.getContext('2d');
    this.image = this.context.createImageData(width, height);
    this.pixels = new Uint32Array(this.image.data.buffer);
    this.depths = new Float32Array(width * height);
  }

  draw(camera, cloud, blend, table, hidden, dots) {
    const {width, height} = this.canvas;
    const {right: r, above: a, ahead: f, target: c, middle: m, focal} = camera;
    this.pixels.fill(0);
    this.depths.fill(Infinity);
    for (let i = 0, k = 0; i < cloud.owners.length; i++, k += 3) {
      const flags = cloud.owners[i], owner = flags & OWNER;
      if (hidden[owner]) continue;
      const x = mix(cloud.sent[k], cloud.merged[k], blend) - c[0];
      const y = mix(cloud.sent[k + 1], cloud.merged[k + 1], blend) - c[1];
      const z = mix(cloud.sent[k + 2], cloud.merged[k + 2], blend) - c[2];
      const away = f[0] * x + f[1] * y + f[2] * z, depth = DISTANCE + away;
      if (depth < 0.1) continue;
      const scale = focal / depth;
      const u = m[0] + scale * (r[0] * x + r[1] * y + r[2] * z);
      const v = m[1] - scale * (a[0] * x + a[1] * y + a[2] * z);
      if (u < 0 || v < 0 || u >= width || v >= height) continue;
      const shade = between(0, Math.floor((away + 1.2) / 2.4 * SHADES), SHADES - 1);
      const colour = table[(2 * owner + (flags & SHARED ? 1 : 0)) * SHADES + shade];
      this.dot(Math.round(u), Math.round(v), flags & LANDMARK ? dots[1] : dots[0], depth, colour);
    }
    this.context.putImageData(this.image, 0, 0);
  }

  dot(u, v, radius, depth, colour) {
    const {width, height} = this.canvas;
    for (let dy = -radius; dy <= radius; dy++) {
      const y = v + dy;
      if (y < 0 || y >= height) continue;
      const half = Math.round(Math.sqrt((radius + 0.4) ** 2 - dy * dy) - 0.1);
      const end = Math.min(u + half, width - 1);
      for (let x = Math.max(u - half, 0); x <= end; x++) {
        const at = y * width + x;
        if (depth >= this.depths[at]) continue;
        this.depths[at] = depth;
        this.pixels[at] = colour;
      }
    }
  }
}
