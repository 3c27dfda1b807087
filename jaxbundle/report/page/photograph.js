// One photograph: residuals as vectors, redundancy numbers as the area of marks.

const LARGE = 3, WEAK = 0.1, ACROSS = ["x", "pixel"];

class PhotographView {
  constructor(frames, { images, observations }) {
    Object.assign(this, { frames, images, observations });
    this.canvas = document.getElementById("photograph-canvas");
    this.said = document.getElementById("photograph-said");
    this.rows = imageRows(observations, images);
    this.select = make("select", { ariaLabel: "image" });
    for (const row of this.byRms()) {
      const text = `${images.cell("id", row)} (RMS ${images.cell("rms", row)})`;
      this.select.append(make("option", { value: row, textContent: text }));
    }
    const place = document.getElementById("photograph-tools");
    place.append(make("label", {}, "image, largest RMS first ", this.select));
    addButton(place, "previous", () => this.step(-1));
    addButton(place, "next", () => this.step(1));
    this.select.addEventListener("change", () => this.draw());
    this.chosen = () => {};
    this.canvas.addEventListener("click", event => this.choosePoint(event));
    window.addEventListener("resize", () => this.draw());
  }

  byRms() {
    const rms = this.images.numbers("rms");
    return Array.from({ length: this.images.length }, (_, i) => i).sort((a, b) => rms[b] - rms[a]);
  }

  step(by) {
    const { options, selectedIndex } = this.select;
    this.select.selectedIndex = (selectedIndex + by + options.length) % options.length;
    this.draw();
  }

  choose(id) {
    this.select.value = String(this.images.row(id));
    this.draw();
  }

  // Image points of an image: two coordinates of a point, in either order.
  collectPoints(image) {
    const table = this.observations, axis = table.numbers("axis"), names = table.names("axis");
    const [point, at, v, r, tau] = ["point", "measured", "v", "r", "tau"]
      .map(name => table.numbers(name));
    const found = new Map();
    for (const row of this.rows[image]) {
      const k = ACROSS.includes(names[axis[row]]) ? 0 : 1;
      const one = found.get(point[row])
        ?? { id: table.cell("point", row), at: [NaN, NaN], v: [0, 0], r: [], tau: 0 };
      one.at[k] = at[row];
      one.v[k] = v[row] || 0;
      one.r.push(r[row]);
      one.tau = Math.max(one.tau, Math.abs(tau[row]) || 0);
      found.set(point[row], one);
    }
    return [...found.values()].filter(one => one.at.every(Number.isFinite));
  }

  draw() {
    const image = Number(this.select.value), frame = this.frames[this.images.cell("camera", image)];
    const points = this.collectPoints(image), { context, wide, high } = begin(this.canvas);
    const bounds = [0, 1].map(k => points.reduce(
      ([low, top], { at }) => [Math.min(low, at[k]), Math.max(top, at[k])],
      [frame.low[k], frame.high[k]]));
    const [width, height] = bounds.map(([low, top]) => top - low || 1);
    const scale = Math.min((wide - 60) / width, (high - 100) / height);
    const sign = frame.down ? 1 : -1;
    const place = (x, y) => [wide / 2 + scale * (x - (bounds[0][0] + bounds[0][1]) / 2),
                             high / 2 - 15 + sign * scale * (y - (bounds[1][0] + bounds[1][1]) / 2)];
    if (frame.known) this.drawFrame(context, frame, place);
    const longest = points.reduce((most, { v }) => Math.max(most, Math.hypot(...v)), 0);
    const factor = longest > 0 ? roundNumber((0.1 * Math.hypot(width, height)) / longest) : 1;
    for (const one of points) this.drawPoint(context, one, place, factor);
    Object.assign(this, { place, placed: points });
    drawBar(context, 20, high - 20, (scale * factor) / frame.scale, `${frame.unit} (residuals)`);
    const large = points.filter(one => one.tau > LARGE).length;
    const rms = this.images.cell("rms", image);
    this.said.textContent = `Image ${this.images.cell("id", image)}: ${points.length} image points, `
      + `${this.images.columns.rms.label} ${rms}, vectors drawn ${factor} times as large, ${large} with |${this.observations.columns.tau.label}| > ${LARGE}.`;
  }

  // `chosen(image, point)` gets the ids of the image point that is clicked.
  choosePoint(event) {
    const box = this.canvas.getBoundingClientRect();
    const [x, y] = [event.clientX - box.left, event.clientY - box.top];
    const away = this.placed.map(({ at }) => {
      const [u, v] = this.place(...at);
      return Math.hypot(u - x, v - y);
    });
    const nearest = away.indexOf(Math.min(...away));
    if (away[nearest] < NEAR) {
      this.chosen(this.images.cell("id", Number(this.select.value)), this.placed[nearest].id);
    }
  }

  drawFrame(context, frame, place) {
    const [[a, b], [c, d]] = [frame.low, frame.high];
    const corners = [[a, b], [c, b], [c, d], [a, d], [a, b]].map(([x, y]) => place(x, y));
    drawLine(context, COLOURS.grey, 1.2, ...corners);
    if (frame.centre === null) return;
    const [x, y] = place(...frame.centre);
    drawLine(context, COLOURS.grey, 1, [x - 6, y], [x + 6, y]);
    drawLine(context, COLOURS.grey, 1, [x, y - 6], [x, y + 6]);
  }

  drawPoint(context, one, place, factor) {
    const start = place(...one.at);
    const end = place(one.at[0] + factor * one.v[0], one.at[1] + factor * one.v[1]);
    const large = one.tau > LARGE, colour = large ? COLOURS.rust : COLOURS.blue;
    drawLine(context, colour, large ? 2.6 : 1.1, start, end);
    const r = one.r.reduce((sum, value) => sum + value, 0) / one.r.length, [x, y] = start;
    if (r < WEAK) {
      drawLine(context, COLOURS.ink, 1.2, [x - 4, y - 4], [x + 4, y + 4]);
      drawLine(context, COLOURS.ink, 1.2, [x - 4, y + 4], [x + 4, y - 4]);
      return;
    }
    context.fillStyle = COLOURS.ink;
    drawMark(context, "circle", x, y, 3.2 * Math.sqrt(Math.min(r, 1)));
  }
}
