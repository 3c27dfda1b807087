// A network: what is clicked with its rays, and stations that are moved.

const RAY = ["kind", "image", "point", "axis", "v", "sigma", "r", "w", "tau", "mdb", "external"];
const MOST_RAYS_LISTED = 200, NEAR_RAY = 6;
const POSE = ["X0", "Y0", "Z0", "omega", "phi", "kappa"];

class Moves {
  constructor({ tables, network, photograph }) {
    Object.assign(this, { tables, network, photograph });
    this.moved = { ...(explored.given.moves ?? {}) };
    this.said = document.getElementById("chosen");
    this.select = document.getElementById("move-station");
    this.aim = document.querySelector("[data-key=aim]");
    this.fields = POSE.map(name => document.getElementById(`move-${name}`));
    for (const id of tables.images.names("id")) {
      this.select.append(make("option", { value: id, textContent: id }));
    }
    network.chosen = (...clicked) => this.choose(...clicked);
    photograph.chosen = (image, point) => this.listRays({ image, point });
    this.select.addEventListener("change", () => this.fill());
    for (const field of this.fields) field.addEventListener("change", () => this.move());
    document.getElementById("move-back").addEventListener("click", () => this.goBack());
    explorer.collect = () => ({ moves: this.moved, aim: this.aim.checked });
    explorer.show.push(answer => this.show(answer));
    this.followMoves();
    this.fill();
  }

  // A station that is moved is drawn where it is now.
  followMoves() {
    const { network } = this, { images } = this.tables;
    this.places = new Map();
    network.placeOf = (table, row, names) => (table === images && this.places.has(row)
      ? network.place(...this.places.get(row).map((x, i) => x - network.centre[i]))
      : NetworkView.prototype.placeOf.call(network, table, row, names));
    this.corners = network.corners.slice();
    // Its ellipsoids, and those of all others, are then those to expect.
    this.expected = new Map();
    network.covarianceOf = (table, row) => this.expected.get(table)?.get(row)
      ?? NetworkView.prototype.covarianceOf.call(network, table, row);
  }

  choose(table, row, at, before) {
    const { images, points } = this.tables;
    if (table === images) {
      this.select.value = images.cell("id", row);
      this.fill();
      this.listRays({ image: images.cell("id", row) });
    } else if (table === points) {
      this.listRays({ point: points.cell("id", row) });
    } else if (table === undefined) {
      const ray = this.nearestRay(at, before);
      if (ray === null) return;
      this.network.station = before;
      this.listRays(ray);
    }
  }

  // The ray that is drawn nearest to a place: of all, or of the station chosen before.
  nearestRay(at, before) {
    const { network } = this, { images, points } = this.tables;
    if (!network.show.rays && before === null) return null;
    let best = { distance: NEAR_RAY };
    network.rays ??= network.collectRays();
    network.rays.forEach((seen, image) => {
      if (!network.show.rays && image !== before) return;
      const start = network.placeOf(images, image, STATION);
      for (const point of seen) {
        const distance = distanceTo(at, start, network.placeOf(points, point, POINT));
        if (distance < best.distance) best = { distance, image, point };
      }
    });
    if (best.image === undefined) return null;
    return { image: images.cell("id", best.image), point: points.cell("id", best.point) };
  }

  // The observations of an image, a point, or of one in the other.
  listRays({ image, point }) {
    const { observations } = this.tables;
    const names = RAY.filter(name => observations.has(name)), rows = [];
    const fits = (name, wanted, row) => wanted === undefined || observations.cell(name, row) === wanted;
    for (let row = 0; row < observations.length; row++) {
      if (fits("image", image, row) && fits("point", point, row)) rows.push(row);
    }
    const cells = row => names.map(name => make("td", { textContent: observations.cell(name, row) }));
    const head = names.map(name =>
      make("th", { scope: "col", textContent: observations.columns[name].label }));
    const title = [["point", point], ["image", image]].filter(([, id]) => id !== undefined)
      .map(([noun, id]) => `${noun} ${id}`).join(" in ");
    const listed = rows.slice(0, MOST_RAYS_LISTED);
    const part = rows.length > listed.length ? `, the first ${listed.length} of them listed` : "";
    this.said.replaceChildren(
      make("p", {}, `${title}: ${rows.length} observations${part}. ${this.describe(image, point)}`),
      make("table", {}, make("thead", {}, make("tr", {}, ...head)),
        make("tbody", {}, ...listed.map(row => make("tr", {}, ...cells(row))))));
  }

  describe(image, point) {
    const [table, id] = point === undefined
      ? [this.tables.images, image] : [this.tables.points, point];
    const row = table.row(id);
    if (row < 0) return "";
    const told = table.shown.map(name => `${table.columns[name].label} ${table.cell(name, row)}`);
    const six = this.expected.get(table)?.get(row);
    if (six !== undefined) {
      const names = table === this.tables.images ? STATION : POINT;
      const sigma = [six[0], six[3], six[5]].map(v => Math.sqrt(Math.max(v, 0)).toPrecision(3));
      told.push(`with the stations moved: ${names.map((n, i) => `σ${n} ${sigma[i]}`).join(", ")}`);
    }
    return told.join(", ");
  }

  fill() {
    const { images } = this.tables, id = this.select.value, row = images.row(id);
    const values = this.moved[id] ?? POSE.map(name => images.numbers(name)[row]);
    this.fields.forEach((field, i) => {
      // A station that is turned to its points has the angles that this needs.
      field.disabled = !explored.live || (i > 2 && this.aim.checked);
      field.value = values[i] === null ? "" : Number(values[i].toFixed(images.columns[POSE[i]].places));
    });
  }

  move() {
    this.moved[this.select.value] = this.fields.map(valueOf);
    if (explored.live) ask();
  }

  goBack() {
    this.moved = {};
    this.fill();
    if (explored.live) ask();
  }

  show({ stations, ellipsoids }) {
    const { network } = this, { images } = this.tables;
    this.expected.clear();
    for (const [name, { rows, elements }] of Object.entries(ellipsoids ?? {})) {
      const six = (row, k) => [row, elements.slice(6 * k, 6 * k + 6)];
      this.expected.set(this.tables[name], new Map(rows.map(six)));
    }
    network.corners.set(this.corners);
    this.places.clear();
    for (const [id, { values, pyramid }] of Object.entries(stations ?? {})) {
      const row = images.row(id);
      this.moved[id] = values;
      this.places.set(row, values.slice(0, 3));
      network.corners.set(pyramid, 15 * row);
    }
    this.fill();
    network.draw();
  }
}

// From a place to a line between two others.
function distanceTo([x, y], [ax, ay], [bx, by]) {
  const [dx, dy] = [bx - ax, by - ay], square = dx * dx + dy * dy || 1;
  const t = Math.min(1, Math.max(0, ((x - ax) * dx + (y - ay) * dy) / square));
  return Math.hypot(ax + t * dx - x, ay + t * dy - y);
}

if (explored.kind === "network") new Moves(shown);
connectControls();
if (explored.answer.parts === undefined) ask();
else putAnswer(explored.answer);
