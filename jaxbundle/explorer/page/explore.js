// Controls whose values go to the server, and what comes back, into its places.

const explored = readData("explore");
// `collect()` gives the values, `show` what else is done with an answer.
const explorer = { collect: readControls, show: [], busy: false, waiting: false, clock: 0 };

function readControls() {
  const fields = document.querySelectorAll("[data-key]");
  return Object.fromEntries([...fields].map(field => [field.dataset.key, valueOf(field)]));
}

function valueOf(field) {
  if (field.type === "checkbox") return field.checked;
  if (field.type !== "number") return field.value;
  // What is shown of a long number is rounded; unchanged, it stands for the whole.
  const { exact } = field.dataset;
  if (exact !== undefined && field.value === field.defaultValue) return Number(exact);
  return field.value === "" ? null : Number(field.value);
}

function say(words) {
  const place = document.getElementById("explore-said");
  if (place !== null) place.textContent = words;
}

// Whether the program computes; what is shown is then still of the values before.
function showWork(busy) {
  explorer.busy = busy;
  document.querySelector("main").setAttribute("aria-busy", busy);
  clearInterval(explorer.clock);
  if (!busy) return;
  const start = Date.now();
  say("computing …");
  explorer.clock = setInterval(() =>
    say(`computing … ${Math.round((Date.now() - start) / 1000)} s`), 1000);
}

function putAnswer(answer) {
  for (const field of document.querySelectorAll("[data-key]")) {
    if (!explored.live) continue;
    field.disabled = (answer.idle ?? []).includes(field.dataset.key);
    const slider = document.querySelector(`[data-slides="${CSS.escape(field.dataset.key)}"]`);
    if (slider !== null) slider.disabled = field.disabled;
  }
  for (const [id, html] of Object.entries(answer.parts ?? {})) {
    document.getElementById(id).innerHTML = html;
  }
  for (const show of explorer.show) show(answer);
}

// In a notebook the page stands in a frame, and the widget around it passes on what is asked.
const framed = location.protocol === "about:";
const asked = new Map();
if (framed) {
  addEventListener("message", ({ source, data }) => {
    if (source !== parent) return;
    asked.get(data.number)?.(data);
    asked.delete(data.number);
  });
}

function sendThroughWidget(action, given) {
  const number = crypto.getRandomValues(new Uint32Array(1))[0];
  return new Promise((resolve, reject) => {
    asked.set(number, ({ error, type, content }) => (error !== undefined
      ? reject(new Error(error))
      : resolve(new Response(content, { headers: { "Content-Type": type } }))));
    parent.postMessage({ number, action, given }, "*");
  });
}

async function send(action, given) {
  if (framed) return sendThroughWidget(action, given);
  const response = await fetch(action, {
    method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(given),
  }).catch(() => { throw new Error("the program has ended"); });
  if (response.ok) return response;
  const { error } = await response.json().catch(() => ({ error: response.statusText }));
  throw new Error(error);
}

// One request at a time; of values that change meanwhile the last ones are asked for.
async function ask() {
  if (explorer.busy) {
    explorer.waiting = true;
    return;
  }
  showWork(true);
  let words = "";
  try {
    putAnswer(await (await send("answer", explorer.collect())).json());
  } catch (error) {
    words = error.message;
  }
  showWork(false);
  say(words);
  if (explorer.waiting) {
    explorer.waiting = false;
    ask();
  }
}

async function takeAway(action, name) {
  try {
    const url = URL.createObjectURL(await (await send(action, explorer.collect())).blob());
    make("a", { href: url, download: name }).click();
    setTimeout(() => URL.revokeObjectURL(url), 10000);
  } catch (error) {
    say(error.message);
  }
}

function connectControls() {
  for (const field of document.querySelectorAll("[data-key]")) {
    const slider = document.querySelector(`[data-slides="${CSS.escape(field.dataset.key)}"]`);
    field.addEventListener("input", () => {
      if (slider !== null) slider.value = field.value;
      ask();
    });
    slider?.addEventListener("input", () => {
      const places = 3 - Math.floor(Math.log10(slider.max - slider.min));
      field.value = Number(Number(slider.value).toFixed(Math.min(Math.max(places, 0), 100)));
      ask();
    });
  }
  for (const button of document.querySelectorAll("[data-export]")) {
    const name = button.dataset.export;
    button.addEventListener("click", () => takeAway(`export/${name}`, name));
  }
  document.getElementById("explore-save")?.addEventListener("click", () =>
    takeAway("save", `${explored.kind}.html`));
}
