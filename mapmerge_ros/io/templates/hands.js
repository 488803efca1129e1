const STEP_PX = 40;             // that an arrow key turns or moves

/** Mouse, touch, keys and buttons of a picture. */
function handle(picture) {
  const {canvas, stage} = picture, fingers = new Map();
  const change = action => { action(picture.camera); picture.moving = true; picture.redraw(); };
  const orbit = (dx, dy) => camera => camera.orbit(3.5 * dx / stage.clientWidth,
                                                   3.5 * dy / stage.clientWidth);
  const pan = (dx, dy) => camera => camera.pan(picture.fine * dx, picture.fine * dy);
  const magnify = factor => camera => camera.magnify(factor);

  canvas.addEventListener('pointerdown', event => {
    canvas.focus({preventScroll: true});
    canvas.setPointerCapture(event.pointerId);
    fingers.set(event.pointerId, event);
  });
  for (const end of ['pointerup', 'pointercancel']) {
    canvas.addEventListener(end, event => fingers.delete(event.pointerId));
  }
  canvas.addEventListener('pointermove', event => {
    const before = fingers.get(event.pointerId);
    if (!before) return;
    const [dx, dy] = [event.clientX - before.clientX, event.clientY - before.clientY];
    const other = [...fingers.values()].find(one => one.pointerId !== event.pointerId);
    fingers.set(event.pointerId, event);
    if (other) {
      const reach = one => Math.hypot(one.clientX - other.clientX, one.clientY - other.clientY);
      change(magnify(reach(event) / Math.max(reach(before), 1)));
      change(pan(dx / 2, dy / 2));
    } else {
      change(event.shiftKey || event.buttons > 1 ? pan(dx, dy) : orbit(dx, dy));
    }
  });
  // One finger may scroll the page (touch-action: pan-y); two belong to the picture.
  for (const kind of ['touchstart', 'touchmove']) {
    canvas.addEventListener(kind, event => event.touches.length > 1 && event.preventDefault(),
                            {passive: false});
  }
  canvas.addEventListener('contextmenu', event => event.preventDefault());
  canvas.addEventListener('wheel', event => {
    // A page that is scrolled past must not be caught by the picture.
    if (document.activeElement !== canvas && !event.ctrlKey) return;
    event.preventDefault();
    change(magnify(Math.exp(-event.deltaY * (event.deltaMode ? 0.05 : 0.0015))));
  }, {passive: false});

  const keys = {
    ArrowLeft: [-STEP_PX, 0], ArrowRight: [STEP_PX, 0],
    ArrowUp: [0, -STEP_PX], ArrowDown: [0, STEP_PX],
  };
  canvas.addEventListener('keydown', event => {
    const {key} = event;
    if (keys[key]) change((event.shiftKey ? pan : orbit)(...keys[key]));
    else if (key === '+' || key === '=') change(magnify(1.25));
    else if (key === '-') change(magnify(0.8));
    else if (key === '0') change(camera => camera.reset());
    else return;
    event.preventDefault();
  });

  const box = stage.closest('section');
  for (const bar of box.querySelectorAll('.bar')) bar.hidden = false;
  const actions = {
    nearer: magnify(1.4), farther: magnify(1 / 1.4), reset: camera => camera.reset(),
  };
  for (const [name, action] of Object.entries(actions)) {
    box.querySelector(`[data-do=${name}]`)?.addEventListener('click', () => change(action));
  }
  for (const radio of box.querySelectorAll('input[type=radio]')) {
    radio.addEventListener('change', () => picture.morph(Number(radio.value)));
  }
  box.querySelector('[data-do=names]')?.addEventListener('change', event => {
    picture.showNames = event.target.checked;
    picture.redraw();
  });
  for (const button of box.querySelectorAll('button[data-object]')) {
    button.disabled = false;
    button.addEventListener('click', () => picture.visit(Number(button.dataset.object)));
  }
  for (const button of box.querySelectorAll('button[data-maps]')) {
    button.disabled = false;
    button.addEventListener('click', () => {
      const isShown = button.getAttribute('aria-pressed') !== 'true';
      button.setAttribute('aria-pressed', isShown);
      for (const map of button.dataset.maps.split(' ')) picture.hidden[map] = !isShown;
      picture.redraw();
    });
  }
}
