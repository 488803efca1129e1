/** One picture of a page: what is drawn, and the hands that turn it. */
class Picture {
  constructor(stage, data, cloud) {
    Object.assign(this, {stage, data, cloud, speed_ms: 0, showNames: true, showMatches: true});
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
    if (this.showMatches) this.matches();
    if (this.showNames) this.names();
  }

  /** From a landmark to the same one in another sub-map; merged they are one point. */
  matches() {
    const {context, cloud} = this, same = this.pairs ??= words(this.data.matches);
    const place = i => [0, 1, 2].map(
      k => mix(cloud.sent[3 * i + k], cloud.merged[3 * i + k], this.blend));
    context.globalAlpha = 0.22;
    context.strokeStyle = css('--open');
    context.lineWidth = 0.7 * this.fine;
    for (let k = 0; k < same.length; k += 2) {
      const hidden = [same[k], same[k + 1]].some(i => this.hidden[cloud.owners[i] & OWNER]);
      if (!hidden) this.line(place(same[k]), place(same[k + 1]));
    }
    context.globalAlpha = 1;
  }

  names() {
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
