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
