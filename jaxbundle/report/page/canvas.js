// Drawing on a canvas: its size follows its width on the screen, a line each for what is repeated.

const COLOURS = {
  ink: "#26323c", grey: "#8d979f", blue: "#2c6089", rust: "#c2512f", green: "#4c8267",
};

// A context whose unit is a pixel of the style sheet, cleared; with its width and height.
function begin(canvas) {
  const ratio = window.devicePixelRatio || 1, shape = canvas.height / canvas.width;
  const wide = canvas.clientWidth || 1000, high = Math.round(wide * shape);
  const context = canvas.getContext("2d");
  if (canvas.width !== Math.round(wide * ratio)) {
    canvas.width = Math.round(wide * ratio);
    canvas.height = Math.round(high * ratio);
  }
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  context.fillStyle = "#fff";
  context.fillRect(0, 0, wide, high);
  context.font = "12px system-ui, sans-serif";
  return { context, wide, high };
}

function drawLine(context, colour, width, ...places) {
  context.strokeStyle = colour;
  context.lineWidth = width;
  context.beginPath();
  places.forEach(([x, y], i) => (i ? context.lineTo(x, y) : context.moveTo(x, y)));
  context.stroke();
}

// Marks that differ by shape, not by colour alone.
function drawMark(context, shape, x, y, size) {
  context.beginPath();
  if (shape === "square") context.rect(x - size, y - size, 2 * size, 2 * size);
  else if (shape === "triangle") polygon(context, x, y, 1.3 * size, 3);
  else if (shape === "diamond") polygon(context, x, y, 1.3 * size, 4);
  else context.arc(x, y, size, 0, 2 * Math.PI);
  context.fill();
}

function polygon(context, x, y, size, corners) {
  for (let i = 0; i < corners; i++) {
    const turn = (2 * Math.PI * i) / corners - Math.PI / 2;
    context.lineTo(x + size * Math.cos(turn), y + size * Math.sin(turn));
  }
  context.closePath();
}

// The largest of 1, 2, 5 times a power of ten that is not above x.
function roundNumber(x) {
  const power = 10 ** Math.floor(Math.log10(x));
  return [5, 2, 1].find(step => step * power <= x * (1 + 1e-12)) * power;
}

// A bar with its length above it; `scale`: pixels a unit.
function drawBar(context, x, y, scale, unit, most = 120) {
  const length = roundNumber(most / scale);
  drawLine(context, COLOURS.ink, 2, [x, y], [x + length * scale, y]);
  context.fillStyle = COLOURS.ink;
  context.fillText(`${Number(length.toPrecision(6))} ${unit}`, x, y - 6);
}

function addButton(place, text, action) {
  const button = make("button", { type: "button", textContent: text });
  button.addEventListener("click", action);
  place.append(button);
}
