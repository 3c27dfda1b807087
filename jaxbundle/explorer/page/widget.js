// A page of the explorer in a notebook: a frame, and what it asks passed on to Python and back.

function render({ model, el }) {
  const frame = document.createElement("iframe");
  frame.sandbox = "allow-scripts allow-downloads";
  frame.srcdoc = model.get("page");
  frame.style.cssText = `width: 100%; height: ${model.get("height")}px; border: 1px solid #8888`;
  const ask = ({ source, data }) => {
    if (source === frame.contentWindow) model.send(data);
  };
  const answer = (told, buffers) => {
    frame.contentWindow?.postMessage({ ...told, content: buffers?.[0] }, "*");
  };
  addEventListener("message", ask);
  model.on("msg:custom", answer);
  el.append(frame);
  return () => {
    removeEventListener("message", ask);
    model.off("msg:custom", answer);
  };
}

export default { render };
