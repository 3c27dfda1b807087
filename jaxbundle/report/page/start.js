// What the page does when it is opened: the drawings at once, a table when it comes into sight.

function fillTables(tables) {
  const seen = new IntersectionObserver(entries => {
    for (const { isIntersecting, target } of entries) {
      if (!isIntersecting) continue;
      seen.unobserve(target);
      fillTable(target, tables);
    }
  }, { rootMargin: "400px" });
  const places = document.querySelectorAll("[data-table]");
  places.forEach(place => seen.observe(place));
  // What is printed is there, whether it was looked at or not.
  window.addEventListener("beforeprint", () => {
    places.forEach(place => fillTable(place, tables)?.fill(0, MOST_PRINTED));
  });
}

function fillTable(place, tables) {
  const table = tables[place.dataset.table];
  return table && place.childElementCount === 0 ? new Listing(place, table) : null;
}

function start() {
  const places = [...document.querySelectorAll("[data-table]")];
  const names = places.map(({ dataset }) => dataset.table);
  const tables = Object.fromEntries(names.map(name => [name, readTable(name)]));
  const frames = readData("frames"), scene = readData("network-data");
  const photograph = frames && new PhotographView(frames, tables);
  const network = scene && new NetworkView(scene, tables, id => photograph.choose(id));
  network?.draw();
  photograph?.draw();
  fillTables(tables);
  return { tables, network, photograph };
}

const shown = start();
