/** One picture of a page: what is drawn, and the hands that turn it. */
class Picture {
  constructor(stage, data, cloud) {
    Object.assign(this, {stage, data, cloud, speed_ms: 0, showNames: true});
    this.blend = data.floor ? 1 : 0;
    this.canvas = stage.querySelector('canvas');
    this.context = this.canvas.getContext('2d');
    this.splatter = new Splatter();
    this.hidden = data.maps.map(() => false);
    this.camera = this.home();
    this.canvas.hidden = false;
    stage.classList.add('live');
    stage.querySelector('svg')?.remove();
    handle(this);
    new ResizeObserver(() => this.redraw()).observe(stage);
    matchMedia('(prefers-color-scheme: dark)').addEventListener('change', () => this.redraw());
  }

  redraw() {
    this.waiting ??= requestAnimationFrame(() => { this.waiting = null; this.draw(); });
  }

  draw() {
    const start = performance.now();
    const fine = this.speed_ms > SLOW_MS && this.moving ? COARSE : FINE;
    const width = Math.round(fine * this.stage.clientWidth);
    const height = Math.round(fine * this.stage.clientHeight);
    if (!width || !height) return;
    Object.assign(this.canvas, {width, height});
    this.splatter.resize(width, height);
    this.fine = fine;
    this.camera.aim(width, height);
    this.floor();
    // Few points are drawn large enough to be seen, many small enough not to hide each other.
    const dot = between(0.6, 2.4 - 0.45 * Math.log10(1 + this.cloud.owners.length / 100), 2);
    const size = this.dotSize * fine * Math.min(1, Math.sqrt(this.stage.clientWidth / 800));
    const dots = [dot, dot + 0.9].map(radius => Math.round(size * radius));
    this.splatter.draw(this.camera, this.cloud, this.blend, this.colours(), this.hidden, dots);
    this.context.drawImage(this.splatter.canvas, 0, 0);
    this.overlay();
    this.speed_ms = performance.now() - start;
    if (fine === COARSE) {
      clearTimeout(this.later);
      this.later = setTimeout(() => { this.moving = false; this.redraw(); }, 200);
    }
  }

  /** Pixels by sub-map, by whether others have the point too, and by depth. */
  colours() {
    const paper = rgb(css('--card')), several = rgb(css('--several'));
    return Uint32Array.from(this.data.maps.flatMap(map => [0, 1].flatMap(shared =>
      Array.from({length: SHADES}, (_, shade) => this.ink(map, shared, several)
        .map((value, k) => Math.round(mix(value, paper[k], 0.55 * shade / SHADES)))
        .reduce((pixel, value, k) => pixel | value << 8 * k, 0xff000000) >>> 0))));
  }

  ink(map, shared, several) {
    return map.colour.map((value, k) => mix(value, several[k], shared * this.blend));
  }

  /** Squares under the merged map. */
  floor() {
    const {floor} = this.data, {context} = this;
    if (!floor || !this.blend) return;
    context.globalAlpha = this.blend;
    context.strokeStyle = css('--line');
    context.lineWidth = this.fine;
    const [x0, y0] = floor.low, [x1, y1] = floor.high;
    const at = (x, y) => [x * floor.step, y * floor.step, floor.height];
    for (let x = x0; x <= x1; x++) this.line(at(x, y0), at(x, y1));
    for (let y = y0; y <= y1; y++) this.line(at(x0, y), at(x1, y));
    context.globalAlpha = 1;
  }

  line(from, to) {
    const [a, b] = [this.camera.project(from), this.camera.project(to)];
    this.context.beginPath();
    this.context.moveTo(a[0], a[1]);
    this.context.lineTo(b[0], b[1]);
    this.context.stroke();
    return [a, b];
  }

  /** Words beside a place, unless others are there already. */
  label(text, point, taken, raise = 0) {
    const {context, fine} = this, [x, below] = this.camera.project(point);
    const y = below - raise * fine;
    context.font = `600 ${13 * fine}px system-ui, sans-serif`;
    const half = context.measureText(text).width / 2, high = 8 * fine;
    if (taken.some(o => Math.abs(o.x - x) < o.half + half && Math.abs(o.y - y) < 2 * high)) return;
    taken.push({x, y, half});
    context.textAlign = 'center';
    context.textBaseline = 'middle';
    context.lineWidth = 4 * fine;
    context.lineJoin = 'round';
    context.strokeStyle = css('--card');
    context.strokeText(text, x, y);
    context.fillStyle = css('--ink');
    context.fillText(text, x, y);
  }
}

/** The sub-maps, as they were sent and merged. */
class MapPicture extends Picture {
  dotSize = 1;

  /** Farther away where sub-maps lie below the map, apart from it. */
  home() {
    const lowest = Math.min(-1, ...this.data.maps.map(map => map.merged[1] - 0.2));
    return new Camera([0, (1 + lowest) / 2, 0], lowest < -1 ? 1.8 / (1 - lowest) : 1);
  }

  overlay() {
    if (!this.showNames) return;
    const {context, data} = this, most = Math.max(1, ...data.links.map(link => link[2]));
    const place = map => map.sent.map((value, k) => mix(value, map.merged[k], this.blend));
    for (const [a, b, count] of data.links) {
      if (this.hidden[a] || this.hidden[b]) continue;
      context.globalAlpha = count ? 0.4 : 1;
      context.strokeStyle = css(count ? '--soft' : '--open');
      context.lineWidth = this.fine * mix(1, 4, Math.sqrt(count / most));
      context.setLineDash(count ? [] : [2 * this.fine, 6 * this.fine]);
      this.line(place(data.maps[a]), place(data.maps[b]));
    }
    context.setLineDash([]);
    context.globalAlpha = 1;
    const taken = [];
    data.maps.forEach((map, k) => {
      const {name, state} = map;
      const text = state === 'merged' || this.blend < 0.5 ? name : `${name}: ${state}`;
      if (!this.hidden[k]) this.label(text, place(map), taken);
    });
  }

  /** To side by side (0) or merged (1), step by step unless the reader wants none. */
  morph(goal) {
    const {camera, blend: from} = this, {turn} = camera, begin = performance.now();
    const still = matchMedia('(prefers-reduced-motion: reduce)').matches;
    const step = now => {
      const share = still ? 1 : between(0, (now - begin) / MORPH_MS, 1);
      const eased = share * share * (3 - 2 * share);
      this.blend = mix(from, goal, eased);
      camera.turn = mix(turn, goal * camera.home.turn, eased);  // rows side by side lie level
      this.moving = share < 1;
      this.draw();
      if (this.goal === goal && share < 1) requestAnimationFrame(step);
    };
    this.goal = goal;
    requestAnimationFrame(step);
  }
}

/** What moved: arrows from where the others have a landmark to where one sub-map has it. */
class ChangePicture extends Picture {
  dotSize = 0.7;

  home() {
    return new Camera(...this.around(this.data.changes));
  }

  /** Target and zoom with which some changes fill the picture. */
  around(changes) {
    const ends = changes.flatMap(change => [change.from, change.to]);
    const target = [0, 1, 2].map(k => ends.reduce((sum, end) => sum + end[k], 0) / ends.length);
    const reach = Math.max(...ends.map(end => Math.hypot(...end.map((x, k) => x - target[k]))));
    return [target, between(0.9, 0.7 / reach, 60)];
  }

  /** Go to an object. */
  visit(number) {
    const [target, zoom] = this.around(this.data.changes.filter(x => x.object === number));
    Object.assign(this.camera, {target, zoom});
    this.stage.scrollIntoView({block: 'nearest'});
    this.redraw();
  }

  /** The map stays in the background. */
  ink(map, shared, several) {
    const paper = rgb(css('--card'));
    return several.map((value, k) => mix(value, paper[k], 0.5));
  }

  overlay() {
    const {context, data, fine} = this, objects = new Map();
    for (const change of data.changes) {
      const level = P_LEVELS.filter(limit => change.p < limit).length;
      context.strokeStyle = context.fillStyle = css(`--p${level}`);
      this.ellipsoid(change);
      this.arrow(change, fine);
      if (change.object && !objects.has(change.object)) objects.set(change.object, change.to);
    }
    const taken = [];
    objects.forEach((to, number) => this.label(`object ${number}`, to, taken, 16));
  }

  arrow(change, fine) {
    this.context.lineWidth = 2 * fine;
    this.context.setLineDash(change.object ? [] : [4 * fine, 3 * fine]);
    const [a, b] = this.line(change.from, change.to);
    this.context.setLineDash([]);
    if (Math.hypot(b[0] - a[0], b[1] - a[1]) < SMALL_PX * fine) this.ring(b, fine);
    const angle = Math.atan2(b[1] - a[1], b[0] - a[0]);
    const length = Math.min(9 * fine, 0.6 * Math.hypot(b[0] - a[0], b[1] - a[1]));
    this.context.beginPath();
    this.context.moveTo(b[0], b[1]);
    for (const side of [2.7, -2.7]) {
      this.context.lineTo(b[0] + length * Math.cos(angle + side),
                          b[1] + length * Math.sin(angle + side));
    }
    this.context.fill();
  }

  /** About what is too small to be seen. */
  ring([x, y], fine) {
    this.context.lineWidth = 1.5 * fine;
    this.context.beginPath();
    this.context.arc(x, y, SMALL_PX * fine, 0, 2 * Math.PI);
    this.context.stroke();
  }

  /** Its outline is an ellipse, whose matrix is that of the ellipsoid seen along the ray. */
  ellipsoid(change) {
    const {camera, context} = this, [x, y, depth] = camera.project(change.to);
    const scale = camera.focal / Math.max(depth, 0.1);
    const seen = (a, b) => scale * scale * a.reduce((sum, value, i) =>
      sum + value * b.reduce((inner, other, j) => inner + change.covariance[i][j] * other, 0), 0);
    const up = camera.above.map(value => -value);
    const [xx, xy, yy] = [seen(camera.right, camera.right), seen(camera.right, up), seen(up, up)];
    const middle = (xx + yy) / 2, off = Math.hypot((xx - yy) / 2, xy);
    const radii = [middle + off, middle - off].map(v => ELLIPSOID * Math.sqrt(Math.max(v, 0)));
    context.beginPath();
    context.ellipse(x, y, ...radii, Math.atan2(2 * xy, xx - yy) / 2, 0, 2 * Math.PI);
    context.globalAlpha = 0.18;
    context.fill();
    context.globalAlpha = 0.8;
    context.lineWidth = this.fine;
    context.stroke();
    context.globalAlpha = 1;
  }
}
