// The data of the page: tables whose columns are unpacked when they are first looked at.

const ARRAYS = {
  u1: Uint8Array, u2: Uint16Array, i4: Int32Array, f4: Float32Array, f8: Float64Array,
};

function readData(id) {
  const element = document.getElementById(id);
  return element === null ? null : JSON.parse(element.textContent);
}

// The numbers of a column: base64 of little-endian values, or one value for all rows.
function unpack(packed, length) {
  if ("same" in packed) return new ARRAYS[packed.type](length).fill(packed.same);
  const text = atob(packed.data);
  const bytes = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
  return new ARRAYS[packed.type](bytes.buffer);
}

class Table {
  constructor(data) {
    this.length = data.length;
    this.columns = data.columns;
    this.shown = Object.keys(data.columns).filter(name => data.columns[name].label !== null);
    this.unpacked = new Map();
  }

  has(name) {
    return name in this.columns;
  }

  names(name) {
    return this.columns[name].names;
  }

  // Numbers, or of a column of names the place of each row's name in the list.
  numbers(name) {
    if (!this.unpacked.has(name)) {
      this.unpacked.set(name, unpack(this.columns[name], this.length));
    }
    return this.unpacked.get(name);
  }

  cell(name, row) {
    const { names, places, digits } = this.columns[name];
    const value = this.numbers(name)[row];
    if (names !== undefined) return names[value];
    return formatNumber(value, digits === undefined ? places : -this.digits(name)[row]);
  }

  // By row the number of significant digits of a column.
  digits(name) {
    const column = this.columns[name];
    column.unpackedDigits ??= unpack(column.digits, this.length);
    return column.unpackedDigits;
  }

  row(wanted, name = "id") {
    const at = this.names(name).indexOf(wanted);
    return at < 0 ? -1 : this.numbers(name).indexOf(at);
  }
}

function readTable(id) {
  const data = readData(`data-${id}`);
  return data === null ? null : new Table(data);
}

// By row of a table the row of another one whose id it names in a column; −1 where there is none.
function rowsOf(table, name, other) {
  const ids = other.names("id");
  const at = new Map(Array.from(other.numbers("id"), (code, row) => [ids[code], row]));
  const found = table.names(name).map(id => at.get(id) ?? -1);
  return Int32Array.from(table.numbers(name), code => found[code]);
}

// By image the rows of the table of observations that are its image coordinates.
function imageRows(observations, images) {
  const found = Array.from({ length: images.length }, () => []);
  const image = rowsOf(observations, "image", images), kind = observations.numbers("kind");
  const wanted = observations.names("kind").indexOf("image");
  for (let row = 0; row < observations.length; row++) {
    if (kind[row] === wanted && image[row] >= 0) found[image[row]].push(row);
  }
  return found;
}

// Decimal places, or minus the number of significant digits.
function formatNumber(value, places) {
  if (Number.isNaN(value)) return "–";
  if (!Number.isFinite(value)) return value > 0 ? "∞" : "−∞";
  if (Number.isInteger(value) && places < 0) return String(value);
  const text = places < 0 ? value.toPrecision(-places) : value.toFixed(places);
  return /^-[0.]+$/.test(text) ? text.slice(1) : text;
}
