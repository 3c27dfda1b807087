// Tables that sort and search; only the rows in sight are in the document.

const ROW_HEIGHT = 22, MARGIN = 20, MOST_PRINTED = 200, MOST_SCROLLED = 1e6;

function make(kind, properties = {}, ...children) {
  const element = Object.assign(document.createElement(kind), properties);
  element.append(...children);
  return element;
}

class Listing {
  constructor(place, table) {
    this.table = table;
    this.file = place.dataset.file;
    this.sorted = { name: null, up: true };
    this.search = make("input", { type: "search", placeholder: "search", ariaLabel: "search" });
    this.count = make("span");
    this.body = make("tbody");
    this.heads = new Map(table.shown.map(name => [name, this.head(name)]));
    const header = make("tr", {}, ...this.heads.values());
    this.scroll = make("div", { className: "scroll", tabIndex: 0 },
      make("table", {}, make("thead", {}, header), this.body));
    place.append(make("div", { className: "tools" }, this.search, this.count), this.scroll);
    this.search.addEventListener("input", () => this.select());
    this.scroll.addEventListener("scroll", () => this.draw());
    window.addEventListener("beforeprint", () => this.fill(0, MOST_PRINTED));
    window.addEventListener("afterprint", () => this.draw());
    this.select();
  }

  head(name) {
    const button = make("button", { textContent: this.table.columns[name].label });
    button.addEventListener("click", () => this.sort(name));
    return make("th", { className: this.kind(name), scope: "col" }, button);
  }

  kind(name) {
    return this.table.names(name) === undefined ? "" : "name";
  }

  sort(name) {
    const up = this.sorted.name === name ? !this.sorted.up : true;
    this.heads.get(this.sorted.name)?.removeAttribute("aria-sort");
    this.heads.get(name).setAttribute("aria-sort", up ? "ascending" : "descending");
    this.sorted = { name, up };
    this.select();
  }

  // The rows that have all words searched for among their names, in the order chosen.
  select() {
    const words = this.search.value.toLowerCase().split(/\s+/).filter(Boolean);
    const found = words.map(word => this.rowsWith(word));
    const all = Uint32Array.from({ length: this.table.length }, (_, i) => i);
    this.order = words.length ? all.filter(row => found.every(has => has(row))) : all;
    if (this.sorted.name !== null) this.order.sort(compareRows(this.table, this.sorted));
    const total = this.table.length;
    this.count.textContent = this.order.length === total
      ? `${total} rows` : `${this.order.length} of ${total} rows`;
    this.scroll.scrollTop = 0;
    this.draw();
  }

  rowsWith(word) {
    const columns = this.table.shown.filter(name => this.kind(name)).map(name => {
      const has = this.table.names(name).map(text => text.toLowerCase().includes(word));
      return { has, rows: this.table.numbers(name) };
    });
    return row => columns.some(({ has, rows }) => has[rows[row]]);
  }

  draw() {
    const first = Math.max(0, Math.floor(this.scroll.scrollTop / ROW_HEIGHT) - MARGIN);
    const seen = Math.ceil((this.scroll.clientHeight || 400) / ROW_HEIGHT);
    this.fill(first, first + seen + 2 * MARGIN, true);
  }

  // Rows of the order; on the screen with the height of those that are left out.
  fill(first, last, scrolled = false) {
    const total = Math.min(this.order.length, MOST_SCROLLED);
    const end = Math.min(last, total);
    const rows = Array.from(this.order.subarray(first, end), row => this.row(row));
    if (scrolled) {
      rows.unshift(this.gap(first));
      rows.push(this.gap(total - end));
    } else if (end < this.order.length) {
      const place = this.file === "" ? "" : `: all are in ${this.file}`;
      const more = `… and ${this.order.length - end} more${place}.`;
      rows.push(make("tr", {}, make("td", { colSpan: this.table.shown.length, className: "name",
                                            textContent: more })));
    }
    this.body.replaceChildren(...rows);
  }

  gap(rows) {
    const row = make("tr");
    row.style.height = `${rows * ROW_HEIGHT}px`;
    return row;
  }

  row(row) {
    return make("tr", {}, ...this.table.shown.map(name =>
      make("td", { className: this.kind(name), textContent: this.table.cell(name, row) })));
  }
}

// Names by their letters and numbers, numbers by their size; what is no number comes last.
function compareRows(table, { name, up }) {
  const rows = table.numbers(name), names = table.names(name);
  let rank = rows;
  if (names !== undefined) {
    const collator = new Intl.Collator("en", { numeric: true });
    const order = names.map((_, i) => i).sort((a, b) => collator.compare(names[a], names[b]));
    const place = new Uint32Array(names.length);
    order.forEach((i, k) => { place[i] = k; });
    rank = rows.map(code => place[code]);
  }
  const sign = up ? 1 : -1;
  return (a, b) => {
    const x = rank[a], y = rank[b];
    if (Number.isNaN(x) || Number.isNaN(y)) return Number.isNaN(x) - Number.isNaN(y);
    return sign * (x - y) || a - b;
  };
}
