// The network in parallel projection: stations, points, rays, error ellipsoids.

const SHAPES = {
  tie: ["circle", 1.6, COLOURS.blue], control: ["triangle", 5, COLOURS.rust],
  fixed: ["square", 4, COLOURS.ink], check: ["diamond", 4, COLOURS.green],
};
const PYRAMID = [[0, 1], [0, 2], [0, 3], [0, 4], [1, 2], [2, 3], [3, 4], [4, 1]];
const VIEWS = { "from above": [0, 0], "from the front": [0, Math.PI / 2], oblique: [0.6, 1.0] };
const MOST_RAYS = 3000, NEAR = 10, MANY = 3000;
const STATION = ["X0", "Y0", "Z0"], POINT = ["X", "Y", "Z"];

class NetworkView {
  // `tell` gets the id of a station that is clicked; `chosen(table, row, at, station)` whatever is
  // at the place of a click, and the station whose rays were drawn before it.
  constructor(scene, { images, points, checks, observations }, tell) {
    Object.assign(this, scene, { images, points, observations, tell });
    this.canvas = document.getElementById("network-canvas");
    this.said = document.getElementById("network-said");
    this.placed = [[images, STATION], [points, POINT], [checks, POINT]].filter(([table]) => table);
    this.show = {
      ellipsoids: true, "ellipsoids of stations": !scene.wide,
      rays: observations.length / 2 < MOST_RAYS,
    };
    this.corners = unpack(scene.pyramids, images.length * 15);
    this.station = null;
    this.chosen = () => {};
    this.reset(VIEWS.oblique);
    this.addTools(document.getElementById("network-tools"));
    followPointer(this.canvas, {
      drag: (dx, dy, moves) => this.move(dx, dy, moves),
      zoom: factor => this.change({ zoom: this.zoom * factor }),
      click: at => this.choose(at),
    });
    this.writeLegend();
    window.addEventListener("resize", () => this.draw());
  }

  reset([azimuth, tilt]) {
    Object.assign(this, { azimuth, tilt, zoom: 0.8, shift: [0, 0] });
  }

  change(values) {
    Object.assign(this, values);
    this.draw();
  }

  move(dx, dy, moves) {
    if (moves) this.change({ shift: [this.shift[0] + dx, this.shift[1] + dy] });
    else this.change({ azimuth: this.azimuth - 0.01 * dx, tilt: this.tilt - 0.01 * dy });
  }

  addTools(place) {
    for (const [name, angles] of Object.entries(VIEWS)) {
      addButton(place, name, () => {
        this.reset(angles);
        this.draw();
      });
    }
    addButton(place, "closer", () => this.change({ zoom: this.zoom * 1.5 }));
    addButton(place, "farther", () => this.change({ zoom: this.zoom / 1.5 }));
    for (const name of Object.keys(this.show)) {
      const box = make("input", { type: "checkbox", checked: this.show[name] });
      box.addEventListener("change", () => {
        this.show[name] = box.checked;
        this.draw();
      });
      place.append(make("label", {}, box, ` ${name}`));
    }
  }

  // The rows of the projection: right and up on the screen.
  axes() {
    const [ca, sa] = [Math.cos(this.azimuth), Math.sin(this.azimuth)];
    const [ct, st] = [Math.cos(this.tilt), Math.sin(this.tilt)];
    return [[ca, sa, 0], [-sa * ct, ca * ct, st]];
  }

  // From the middle of the network to the screen.
  place(x, y, z) {
    const { axes: [right, up], scale, middle } = this.frame;
    return [middle[0] + scale * (right[0] * x + right[1] * y + right[2] * z),
            middle[1] - scale * (up[0] * x + up[1] * y + up[2] * z)];
  }

  placeOf(table, row, names) {
    return this.place(...names.map((name, i) => table.numbers(name)[row] - this.centre[i]));
  }

  // Where a row is drawn; null if it is at any distance, or outside the drawing.
  findInside(table, row, names) {
    if (table.has("near") && !table.numbers("near")[row]) return null;
    const [x, y] = this.placeOf(table, row, names), { wide, high } = this.frame;
    return x > -50 && y > -50 && x < wide + 50 && y < high + 50 ? [x, y] : null;
  }

  draw() {
    const { context, wide, high } = begin(this.canvas);
    const scale = (this.zoom * Math.min(wide, high)) / this.size;
    const middle = [wide / 2 + this.shift[0], high / 2 + this.shift[1]];
    this.frame = { axes: this.axes(), scale, middle, wide, high };
    if (this.show.rays || this.station !== null) this.drawRays(context);
    this.drawStations(context);
    for (const [table] of this.placed) if (table !== this.images) this.drawPoints(context, table);
    this.drawEllipsoids(context);
    drawBar(context, 20, high - 20, scale, this.unit);
    this.drawAxes(context, wide - 70, high - 60);
  }

  drawStations(context) {
    for (let image = 0; image < this.images.length; image++) {
      const places = [0, 3, 6, 9, 12].map(k => {
        const first = 15 * image + k;
        return this.place(...this.corners.subarray(first, first + 3));
      });
      const width = image === this.station ? 2.4 : 0.8;
      for (const [a, b] of PYRAMID) drawLine(context, COLOURS.grey, width, places[a], places[b]);
      context.fillStyle = COLOURS.ink;
      drawMark(context, "circle", ...places[0], 2.5);
    }
  }

  // By role; a table without roles has check points.
  drawPoints(context, table) {
    const shrink = table.length > MANY ? 0.5 : 1;
    for (let row = 0; row < table.length; row++) {
      const at = this.findInside(table, row, POINT);
      if (at === null) continue;
      const role = table.has("role") ? table.cell("role", row) : "check";
      const [shape, size, colour] = SHAPES[role];
      context.fillStyle = colour;
      drawMark(context, shape, ...at, shape === "circle" ? shrink * size : size);
    }
  }

  // The outline of an ellipsoid seen in parallel is the ellipse of its covariance on the screen.
  drawEllipsoids(context) {
    const { points, images } = this.ellipsoids;
    context.strokeStyle = points.length < this.points.length ? "rgba(38,52,60,.5)" : COLOURS.ink;
    context.lineWidth = 0.7;
    const wanted = [
      [this.points, POINT, this.show.ellipsoids ? points : []],
      [this.images, STATION, this.show["ellipsoids of stations"] ? images : []],
    ];
    for (const [table, names, rows] of wanted) {
      for (const row of rows) {
        const at = this.findInside(table, row, names);
        if (at === null) continue;
        const { a, b, turn } = this.outline(table, row);
        if (!(a > 0)) continue;
        context.beginPath();
        context.ellipse(...at, a, b, turn, 0, 2 * Math.PI);
        context.stroke();
      }
    }
  }

  covarianceOf(table, row) {
    return ["c00", "c01", "c02", "c11", "c12", "c22"].map(name => table.numbers(name)[row]);
  }

  outline(table, row) {
    const [xx, xy, xz, yy, yz, zz] = this.covarianceOf(table, row);
    const times = (u, v) => u[0] * (xx * v[0] + xy * v[1] + xz * v[2])
      + u[1] * (xy * v[0] + yy * v[1] + yz * v[2]) + u[2] * (xz * v[0] + yz * v[1] + zz * v[2]);
    const [right, up] = this.frame.axes;
    // Down is positive on the screen.
    const [p, q, r] = [times(right, right), -times(right, up), times(up, up)];
    const middle = (p + r) / 2, half = Math.hypot((p - r) / 2, q);
    const length = square => this.frame.scale * this.factor * Math.sqrt(Math.max(square, 0));
    const turn = Math.atan2(2 * q, p - r) / 2;
    return { a: length(middle + half), b: length(middle - half), turn };
  }

  drawRays(context) {
    this.rays ??= this.collectRays();
    this.rays.forEach((points, image) => {
      const own = image === this.station;
      if (!own && !this.show.rays) return;
      const start = this.placeOf(this.images, image, STATION);
      const [colour, width] = own ? [COLOURS.rust, 1] : ["rgba(44,96,137,.25)", 0.5];
      for (const point of points) {
        drawLine(context, colour, width, start, this.placeOf(this.points, point, POINT));
      }
    });
  }

  // By image the points that were measured in it.
  collectRays() {
    const { observations, images, points } = this, near = points.numbers("near");
    const point = rowsOf(observations, "point", points);
    return imageRows(observations, images).map(rows =>
      [...new Set(rows.map(row => point[row]))].filter(p => p >= 0 && near[p]));
  }

  drawAxes(context, x, y) {
    const [right, up] = this.frame.axes;
    POINT.forEach((name, i) => {
      if (Math.hypot(right[i], up[i]) < 0.05) return;
      const end = [x + 35 * right[i], y - 35 * up[i]];
      drawLine(context, COLOURS.ink, 1.2, [x, y], end);
      context.fillStyle = COLOURS.ink;
      context.fillText(name, end[0] + 3, end[1] + 3);
    });
  }

  choose(at) {
    let best = { distance: NEAR };
    for (const [table, names] of this.placed) {
      for (let row = 0; row < table.length; row++) {
        const place = this.findInside(table, row, names);
        if (place === null) continue;
        const distance = Math.hypot(place[0] - at[0], place[1] - at[1]);
        if (distance < best.distance) best = { distance, table, row };
      }
    }
    const { table, row } = best, before = this.station;
    this.station = table === this.images ? row : null;
    this.said.textContent = table === undefined ? "" : table.shown
      .map(name => `${table.columns[name].label} ${table.cell(name, row)}`).join(", ");
    if (this.station !== null) this.tell(table.cell("id", row));
    this.chosen(table, row, at, before);
    this.draw();
  }

  writeLegend() {
    const roles = this.points.names("role").map(role => `${SHAPES[role][0]}: ${role} point`);
    document.getElementById("network-legend").textContent = [
      "pyramid: station and image corners", ...roles,
      this.drawn,
      "the bar is the scale of the network",
    ].join("; ");
  }
}
