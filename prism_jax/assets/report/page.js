const clouds = document.getElementById("clouds");
const toggles = [...document.querySelectorAll("[data-cloud]")];
const choices = [...document.querySelectorAll("[data-object]")];
const modes = [...document.querySelectorAll("[data-colors]")];
const pressed = (button) => button.getAttribute("aria-pressed") === "true";
const press = (button, on) => button.setAttribute("aria-pressed", on);

const scenes = Object.keys(clouds.layout).filter((key) => key.startsWith("scene"));
const view = (name) => clouds._fullLayout[name] && clouds._fullLayout[name]._scene;
const pose = (name) => ["eye", "center", "up"].map(
  (key) => Array.from(view(name).camera[key]));

// It was drawn before what stands beside it had its place.
Plotly.Plots.resize(clouds);

// Everything that is shown follows from which buttons are pressed.
function show(layout = {}) {
  const hidden = toggles.filter((b) => !pressed(b)).map((b) => b.dataset.cloud);
  const chosen = choices.find(pressed);
  const alone = chosen && chosen.dataset.object ? Number(chosen.dataset.object) : null;
  const traces = clouds.data.map((trace) => trace.meta);
  const seen = (about) => !hidden.includes(about.cloud)
    && (alone === null || about.object === alone);
  const style = { visible: traces.map(seen) };
  if (modes.length) {
    const mode = modes.find(pressed), own = mode ? mode.dataset.colors : "";
    document.body.className = mode ? `by-${own}` : "";
    const colors = traces.map((about) => (about.color ? about.color[own] : undefined));
    style["marker.color"] = colors;
    style["marker.coloraxis"] = colors.map((c) => (Array.isArray(c) ? "coloraxis" : null));
    layout = { ...layout, "coloraxis.showscale": own === "error" };
  }
  const size = Number(alone !== null);
  if (choices.length) style["marker.size"] = traces.map((about) => about.size[size]);
  Plotly.update(clouds, style, layout);
}
for (const button of [...toggles, ...modes]) {
  button.addEventListener("click", () => {
    // One way to colour at a time.
    for (const other of modes) {
      if (modes.includes(button) && other !== button) press(other, false);
    }
    press(button, !pressed(button));
    show();
  });
}
function choose(button) {
  for (const other of choices) press(other, other === button);
  show(boxes[choices.indexOf(button)]);
}
for (const button of choices) button.addEventListener("click", () => choose(button));
document.addEventListener("keydown", (event) => {
  if (event.key === "Escape" && choices.length) choose(choices[0]);
});

// Charts that were folded away have no size until they are opened.
for (const part of document.querySelectorAll("details")) {
  part.addEventListener("toggle", () => {
    for (const chart of part.querySelectorAll(".js-plotly-plot")) {
      Plotly.Plots.resize(chart);
    }
  });
}

// The view under the pointer leads and the others follow it, frame by frame: Plotly's
// own events come before the camera has moved.
const distance = (a, b) => Math.max(
  ...a.flat().map((value, index) => Math.abs(value - b.flat()[index])));
let leader = scenes[0];
function lead(event) {
  leader = scenes.find((name) => {
    const box = view(name) && view(name).container.getBoundingClientRect();
    return box && box.left <= event.clientX && event.clientX < box.right;
  }) || leader;
}
function follow() {
  if (view(leader)) {
    const target = pose(leader);
    for (const name of scenes) {
      if (name !== leader && view(name) && distance(pose(name), target) > 1e-5) {
        view(name).camera.lookAt(...target);
      }
    }
  }
  requestAnimationFrame(follow);
}
for (const kind of ["pointerdown", "wheel"]) {
  clouds.addEventListener(kind, lead, { capture: true, passive: true });
}
if (scenes.length > 1) follow();
