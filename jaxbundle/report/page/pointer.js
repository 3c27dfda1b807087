// What mouse, pen or finger do on a canvas: drag, drag with Shift, wheel, click.

function followPointer(canvas, { drag, zoom, click }) {
  let last = null, moved = 0;
  const place = event => {
    const box = canvas.getBoundingClientRect();
    return [event.clientX - box.left, event.clientY - box.top];
  };
  canvas.addEventListener("pointerdown", event => {
    [last, moved] = [place(event), 0];
    canvas.setPointerCapture(event.pointerId);
  });
  canvas.addEventListener("pointermove", event => {
    if (last === null) return;
    const now = place(event), [dx, dy] = [now[0] - last[0], now[1] - last[1]];
    moved += Math.abs(dx) + Math.abs(dy);
    last = now;
    drag(dx, dy, event.shiftKey);
  });
  canvas.addEventListener("pointerup", event => {
    if (moved < 4) click(place(event));
    last = null;
  });
  canvas.addEventListener("wheel", event => {
    event.preventDefault();
    zoom(Math.exp(-0.001 * event.deltaY));
  }, { passive: false });
}
