"use strict";
// Shows every run at the clock's time: the moving traces of its scene, and the cursor and values of its plots.

const data = JSON.parse(document.getElementById("data").textContent);
const { runs, colours } = data;
const FRAME = 1000 / 30; // ms between two drawings while playing
const MARGIN = { l: 56, r: 10, t: 6, b: 24 }; // px around a plot
// Of every plot: its toolbar has no button that uploads the chart, and no address to send it to.
const LOCAL = { responsive: true, displaylogo: false, showSendToCloud: false, plotlyServerURL: "" };
const MAX_PATH = 500; // corners of the flown path
const VIEW = [1.15, 1.15, 0.65]; // from the chief to the camera, in plotly's units
const SEEN = 0.65; // how far from the chief all is in that view; what is farther is looked at from farther away

const byId = (name) => document.getElementById(name);
const end = Math.max(...runs.map((run) => run.end)); // s
const label = (i) => (runs.length > 1 ? `${"AB"[i]}: ` : "");

function element(tag, className, parent, text = "") {
  const made = document.createElement(tag);
  made.className = className;
  made.textContent = text;
  parent.append(made);
  return made;
}

// With so many decimals, and no sign before zero.
const shortened = (value, decimals) => value.toFixed(decimals).replace(/^-(?=[0.]*$)/, "");

// The last row that is not after t.
function rowAt(run, t) {
  let [low, high] = [0, run.time.length];
  while (high - low > 1) {
    const middle = (low + high) >> 1;
    if (run.time[middle] <= t) low = middle;
    else high = middle;
  }
  return low;
}

// ---- the scene ----

const scaled = (a, factor) => a.map((component) => factor * component);
const sum = (a, b) => a.map((component, i) => component + b[i]);
const inner = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
// A vector along a body's axes, in Hill's frame.
const along = (axes, v) => axes.map((axis, i) => scaled(axis, v[i])).reduce(sum);
const ofChief = (run, row, v) => (run.chief_axes ? along(run.chief_axes[row], v) : v);
// A ball just below the points, or of a mesh the corners of its faces, one after the other.
const chief = (run, row) =>
  run.corners
    ? run.corners.map((corner) => ofChief(run, row, corner))
    : run.points.map((point) => ofChief(run, row, scaled(point, 0.97)));

// Corners of the traces that change with the row, by name, each [x, y, z] in m in Hill's frame.
function moving(run, row) {
  const p = run.position[row];
  const axes = run.axes[row];
  const sun = [Math.cos(run.sun_angle[row]), Math.sin(run.sun_angle[row]), 0];
  const points = { inspected: [], lit: [], dark: [] };
  run.normals.forEach((normal, i) => {
    const inspected = run.inspected[i] !== null && run.inspected[i] <= run.time[row];
    const lit = inner(ofChief(run, row, normal), sun) > 0 && !(run.shaded && run.shaded[row].includes(i));
    const kind = inspected ? "inspected" : lit ? "lit" : "dark";
    points[kind].push(ofChief(run, row, run.points[i]));
  });
  const stride = Math.ceil(run.position.length / MAX_PATH);
  const flown = run.position.slice(0, row).filter((_, i) => i % stride === 0);
  const axis = (i) => [p, sum(p, scaled(axes[i], data.lengths.axis))];
  return {
    ...(run.corners && { chief: chief(run, row) }),
    ...points,
    flown: [...flown, p],
    deputy: [p],
    sun: [scaled(sun, 1.2 * run.chief_radius), scaled(sun, data.lengths.direction)],
    cone: [p, ...run.rim.map((edge) => sum(p, scaled(along(axes, edge), data.lengths.cone)))],
    x: axis(0),
    y: axis(1),
    z: axis(2),
  };
}

const place = ([x, y, z]) => ({ x, y, z });

// What a trace of no point needs to be drawn later: one that is nowhere.
const columns = (corners) => {
  const drawn = corners.length ? corners : [[null, null, null]];
  return { x: drawn.map((p) => p[0]), y: drawn.map((p) => p[1]), z: drawn.map((p) => p[2]) };
};

// Which corners make a face; without a mesh, those of the hull.
function faces(run) {
  if (!run.corners) return { alphahull: 0 };
  const third = (k) => run.corners.map((_, i) => i).filter((i) => i % 3 === k);
  return { i: third(0), j: third(1), k: third(2) };
}

function style(name, run, dot) {
  const line = (width, text) => ({
    type: "scatter3d",
    mode: text ? "lines+text" : "lines",
    line: { color: colours[name], width },
    ...(text && { text: ["", text], textfont: { color: colours.text, size: 13 } }),
  });
  const markers = (symbol, size) => ({
    type: "scatter3d",
    mode: "markers",
    marker: { color: colours[name], symbol, size, line: { width: 0 } },
  });
  const first = run.rim.map(() => 0);
  const second = run.rim.map((_, i) => i + 1);
  const third = run.rim.map((_, i) => ((i + 1) % run.rim.length) + 1);
  return {
    chief: { type: "mesh3d", ...faces(run), color: colours.chief, flatshading: true },
    path: line(2),
    earth: line(5, "Earth"),
    inspected: markers("circle", dot),
    lit: markers("diamond", dot),
    dark: markers("square", 0.8 * dot),
    flown: line(4),
    deputy: markers("circle", 5),
    sun: line(5, "Sun"),
    cone: { type: "mesh3d", i: first, j: second, k: third, color: colours.cone, opacity: 0.2 },
    x: line(6, "x"),
    y: line(6, "y"),
    z: line(6, "z"),
  }[name];
}

function drawScene(run, i) {
  const figure = element("figure", "run", byId("scenes"));
  element("h2", "", figure, label(i) + run.name);
  const plot = element("div", "scene", figure);
  const status = element("figcaption", "status", figure);
  const fixed = {
    ...(!run.corners && { chief: chief(run, 0) }), // as a sphere, it looks the same however it turns
    path: run.position,
    earth: [
      [-1.2 * run.chief_radius, 0, 0],
      [-data.lengths.direction, 0, 0],
    ],
  };
  const traces = Object.entries({ ...fixed, ...moving(run, 0) }).map(([name, corners]) => ({
    name,
    hoverinfo: "skip",
    ...style(name, run, data.dot * Math.min(1, plot.clientWidth / 550)),
    ...columns(corners),
  }));
  const axis = (name, k) => ({
    title: { text: `${name} (m)` },
    range: data.ranges[k],
    showbackground: false,
    gridcolor: "#e2e2e2",
    zeroline: false,
    nticks: 6,
  });
  const layout = {
    margin: { l: 0, r: 0, t: 0, b: 0 },
    showlegend: false,
    hovermode: false,
    scene: {
      aspectmode: "manual",
      aspectratio: place(data.aspect),
      dragmode: "turntable",
      camera: {
        eye: place(sum(data.centre, scaled(VIEW, Math.max(1, data.reach / SEEN)))),
        center: place(data.centre),
      },
      xaxis: axis("x", 0),
      yaxis: axis("y", 1),
      zaxis: axis("z", 2),
    },
  };
  Plotly.newPlot(plot, traces, layout, LOCAL);
  const first = Object.keys(fixed).length;
  const indices = traces.map((_, k) => k).slice(first);
  let shown = 0;
  let turned = false;
  plot.addEventListener("pointerdown", () => (turned = true));

  return (t) => {
    const row = rowAt(run, t);
    const corrected = Object.keys(run.interventions).filter((control) =>
      run.interventions[control].some(([from, to]) => from <= t && t < to),
    );
    status.textContent = [
      `distance ${Math.hypot(...run.position[row]).toFixed(1)} m`,
      `speed ${run.speed[row].toFixed(2)} m/s`,
      corrected.length ? `filter corrects ${corrected.join(" and ")}` : "no correction",
      ...(t >= run.end && run.end < end ? [`ends at ${run.end} s`] : []),
    ].join(" · ");
    if (row === shown) return;
    shown = row;
    const now = Object.values(moving(run, row)).map(columns);
    const update = Object.fromEntries(["x", "y", "z"].map((name) => [name, now.map((c) => c[name])]));
    // restyle puts the camera where the layout has it, which does not follow a hand before it lets go
    if (turned) plot.layout.scene.camera = plot._fullLayout.scene._scene.getCamera();
    Plotly.restyle(plot, update, indices);
  };
}

// ---- the plots ----

function drawPanel(panel, run, i, [low, high], parent) {
  const figure = element("figure", "panel", parent);
  const caption = element("figcaption", "", figure);
  element("b", "", caption, `${label(i)}${panel.title} `);
  element("span", "", caption, panel.unit && `(${panel.unit}) `);
  const values = panel.lines.map((line) => {
    const value = element("span", "value", caption);
    value.style.color = line.colour;
    return value;
  });
  const plot = element("div", "plot", figure);
  const lines = panel.lines.map((line) => ({
    x: run.time,
    y: line.values,
    mode: "lines",
    line: { color: line.colour, width: line.width, shape: line.held ? "hv" : "linear" },
  }));
  const corrected = run.interventions[panel.acts] ?? [];
  const foot = low + 0.04 * (high - low);
  lines.push({
    x: corrected.flatMap((interval) => [...interval, null]),
    y: corrected.flatMap(() => [foot, foot, null]),
    mode: "lines",
    line: { color: colours.intervention, width: 6 },
  });
  const [least, most] = panel.safe;
  const limits = panel.safe.filter((limit) => limit !== null);
  const rectangle = { type: "rect", layer: "below", line: { width: 0 }, xref: "paper", x0: 0, x1: 1 };
  const shapes = limits.map((y) => ({
    type: "line",
    xref: "paper",
    x0: 0,
    x1: 1,
    y0: y,
    y1: y,
    line: { color: colours.text, width: 1, dash: "dot" },
  }));
  if (limits.length) {
    shapes.push({ ...rectangle, y0: low, y1: high, fillcolor: colours.unsafe });
    shapes.push({ ...rectangle, y0: least ?? low, y1: most ?? high, fillcolor: colours.safe });
  }
  const axis = { fixedrange: true, zeroline: false, gridcolor: "#ececec", tickfont: { size: 11 } };
  const layout = {
    margin: MARGIN,
    showlegend: false,
    xaxis: { ...axis, range: [0, end], ticksuffix: " s", nticks: 6 },
    yaxis: { ...axis, range: [low, high], nticks: 5 },
    shapes,
  };
  Plotly.newPlot(plot, lines, layout, { ...LOCAL, staticPlot: true });
  const cursor = element("div", "cursor", plot);
  const scrub = (event) => {
    const box = plot.getBoundingClientRect();
    const share = (event.clientX - box.left - MARGIN.l) / (box.width - MARGIN.l - MARGIN.r);
    if (event.buttons === 1) show(share * end);
  };
  plot.addEventListener("pointerdown", scrub);
  plot.addEventListener("pointermove", scrub);

  const decimals = Math.min(6, Math.max(0, 2 - Math.floor(Math.log10(high - low))));
  return (t) => {
    const row = rowAt(run, t);
    cursor.style.left = `calc(${MARGIN.l}px + (100% - ${MARGIN.l + MARGIN.r}px) * ${t / end})`;
    panel.lines.forEach((line, k) => {
      values[k].textContent = `${line.name} ${shortened(line.values[row], decimals)} `;
    });
  };
}

function drawSection(title, panels) {
  const section = element("section", "", byId("sections"));
  element("h2", "", section, title);
  const grid = element("div", runs.length > 1 ? "panels pairs" : "panels", section);
  return panels.flatMap((panel) =>
    panel.runs.map((own, i) => drawPanel(own, runs[i], i, panel.range, grid)),
  );
}

// ---- the clock ----

const title = document.title;
let time = 0;
let playing = false;
let lastFrame = 0;
let nextFrame = 0;

function show(t) {
  time = Math.min(Math.max(t, 0), end);
  byId("scrub").value = time;
  byId("clock").textContent = `${time.toFixed(0)} s`;
  views.forEach((view) => view(time));
}

function play(wanted) {
  playing = wanted;
  byId("play").textContent = playing ? "❚❚ Pause" : "▶ Play";
  if (!playing) return;
  if (time >= end) show(0);
  lastFrame = performance.now();
  cancelAnimationFrame(nextFrame); // of a play that was paused within the same frame
  nextFrame = requestAnimationFrame(frame);
}

function frame(now) {
  if (!playing) return;
  if (now - lastFrame >= FRAME) {
    const elapsed = Math.min(now - lastFrame, 250) / 1000; // a tab that was hidden does not jump
    lastFrame = now;
    show(time + elapsed * Number(byId("speed").value));
    if (time >= end) play(false);
  }
  nextFrame = requestAnimationFrame(frame);
}

byId("scrub").max = end;
byId("scrub").addEventListener("input", (event) => show(Number(event.target.value)));
byId("play").addEventListener("click", () => play(!playing));
document.addEventListener("keydown", (event) => {
  const steps = { ArrowLeft: -data.step, ArrowRight: data.step };
  if (event.target.matches("select") || event.ctrlKey || event.altKey || event.metaKey) return;
  if (event.key === " " && !event.target.matches("button")) play(!playing);
  else if (event.key in steps) show(time + steps[event.key]);
  else return;
  event.preventDefault();
});

byId("scenes").className = runs.length > 1 ? "pairs" : "";
const views = [
  ...runs.map(drawScene),
  ...Object.entries(data.sections).flatMap(([name, panels]) => drawSection(name, panels)),
];
show(0);
// not at every frame: setting it takes a browser longer than the scene does
setInterval(() => {
  const now = `${time.toFixed(0)} s · ${title}`;
  if (document.title !== now) document.title = now;
}, 1000);
