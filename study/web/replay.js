// Shows every run at the clock's time: its scene, and the cursor and values of its plots.
"use strict";

const data = JSON.parse(document.getElementById("data").textContent);
const { runs } = data;
const FOOT = 0.04; // share of a plot's height in which interventions are marked
const LOOKS = [["first", 1.4], ["second", 1.4], ["third", 1.4]]; // colour and width of a plot's lines
const HELD = [["wanted", 2.5], ["first", 1.2]]; // of a desired and an applied control
const ACROSS = 1000, DOWN = 100; // size of a plot, in its own units
const SVG = "http://www.w3.org/2000/svg"; // a name only; nothing is loaded from there

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

// Writes a number with so many decimals, and no sign before zero.
const shortened = (value, decimals) => value.toFixed(decimals).replace(/^-(?=[0.]*$)/, "");
const decimals_of = (range) => Math.min(6, Math.max(0, 2 - Math.floor(Math.log10(range))));

// Returns the last row that is not after t.
const rowAt = (run, t) => Math.max(0, run.time.findLastIndex((each) => each <= t));

// ---- the scene ----

class Film extends Scene {
  constructor(canvas, run, looks) {
    super(canvas, run, looks);
    this.run = run;
    const count = run.position.length;
    this.whole = this.line(COLOURS.trail, 0.3, count);
    this.fill(this.whole, Float32Array.from(run.position.flat()), count);
    this.trail = this.line(COLOURS.trail, 0.9, count + 1);
    this.ahead = this.line(COLOURS.ahead, 0.6, run.ahead[0].length);
  }

  // returns inspected, lit or dark for each point in a row
  kinds(row) {
    const { run } = this, angle = run.sun_angle[row], time = run.time[row];
    const sun = new THREE.Vector3(Math.cos(angle), Math.sin(angle), 0);
    if (run.chief) sun.applyQuaternion(new THREE.Quaternion(...run.chief[row]).invert());
    const shaded = new Set(run.shaded ? run.shaded[row] : []);
    return run.normals.map(([x, y, z], i) => {
      if (run.inspected[i] !== null && run.inspected[i] <= time) return "inspected";
      return x * sun.x + y * sun.y + z * sun.z > 0 && !shaded.has(i) ? "lit" : "dark";
    });
  }

  // shows the numbers at time t, interpolated linearly between two rows
  show(t) {
    const { run } = this, last = run.time.length - 1;
    const row = rowAt(run, t), next = Math.min(row + 1, last);
    const share = row < last ? Math.min(1, (t - run.time[row]) / (run.time[next] - run.time[row])) : 0;
    const between = (values) => mixed(values[row], values[next], share);
    const p = between(run.position);
    if (row !== this.row) {
      this.row = row;
      this.colour(this.kinds(row));
      this.fill(this.trail, Float32Array.from(run.position.slice(0, row + 1).flat()), row + 1);
    }
    this.trail.geometry.attributes.position.setXYZ(row + 1, ...p);
    this.trail.geometry.setDrawRange(0, row + 2);
    this.coast(p, (row + share) / Math.ceil(run.time.length / run.ahead.length));
    this.draw({
      p,
      q: turned(run.quaternion[row], run.quaternion[next], share),
      sun: run.sun_angle[row],
      ...(run.chief && { chief: turned(run.chief[row], run.chief[next], share) }),
      desired: run.desired[row],
      control: run.control[row],
      from: Math.max(...runs.map((each) => Math.hypot(...each.position[rowAt(each, t)]))), // one scale for all runs
    });
  }

  // draws the free flight from p, interpolated between two known ones
  coast(p, place) {
    const { ahead } = this.run, at = Math.min(Math.floor(place), ahead.length - 1);
    const later = ahead[Math.min(at + 1, ahead.length - 1)];
    const places = ahead[at].map((each, i) => (i ? mixed(each, later[i], place - at) : p));
    this.fill(this.ahead, Float32Array.from(places.flat()), places.length);
  }
}

const looks = first_looks(); // shared by all scenes
const films = [];

function drawScene(run, i) {
  const figure = element("figure", "run", byId("scenes"));
  element("h2", "", figure, label(i) + run.name);
  const canvas = element("canvas", "scene", figure);
  canvas.setAttribute("aria-label", "The deputy, the chief and the Sun");
  const status = element("figcaption", "status", figure);
  const [beside] = Object.values(data.sections);
  const numbers = beside.map((panel) => {
    const own = panel.runs[i], [{ values }] = own.lines;
    const decimals = decimals_of(panel.range[1] - panel.range[0]);
    return (row) => `${own.title.toLowerCase()} ${shortened(values[row], decimals)} ${own.unit}`.trim();
  });
  let film = null;
  try {
    film = new Film(canvas, run, looks);
    film.view = byId("view").value;
    film.turned = () => show(time);
  } catch (error) { // no WebGL here
    canvas.replaceWith(element("p", "missing", figure, "This browser draws no WebGL: the plots below still play."));
  }
  films.push(film);

  return (t) => {
    const row = rowAt(run, t);
    const corrected = Object.keys(run.interventions).filter((control) =>
      run.interventions[control].some(([from, to]) => from <= t && t < to),
    );
    status.textContent = [
      ...numbers.map((number) => number(row)),
      corrected.length ? `filter corrects ${corrected.join(" and ")}` : "no correction",
      ...(t >= run.end && run.end < end ? [`ends at ${run.end} s`] : []),
    ].join(" · ");
    if (film) film.show(t);
  };
}

// ---- the plots ----

// Returns round numbers within a range, about `count`.
function ticks(low, high, count) {
  const least = (high - low) / count, power = 10 ** Math.floor(Math.log10(least));
  const step = power * [1, 2, 5, 10].find((times) => times * power >= least);
  const first = Math.ceil(low / step), digits = Math.max(0, -Math.floor(Math.log10(step)));
  const found = Array.from({ length: Math.floor(high / step) - first + 1 }, (_, i) => (first + i) * step);
  return found.map((value) => [value, shortened(value, digits)]);
}

function shape(tag, parent, attributes, colour = "") {
  const made = document.createElementNS(SVG, tag);
  for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
  if (colour) made.style[tag === "rect" ? "fill" : "stroke"] = `var(--${colour})`;
  parent.append(made);
  return made;
}

function drawPanel(panel, run, i, [low, high], parent) {
  const figure = element("figure", "panel", parent);
  const caption = element("figcaption", "", figure);
  element("b", "", caption, `${label(i)}${panel.title} `);
  element("span", "", caption, panel.unit && `(${panel.unit}) `);
  const looks = panel.held ? HELD : LOOKS;
  const values = panel.lines.map((_, k) => {
    const value = element("span", "value", caption);
    value.style.color = `var(--${looks[k][0]})`;
    return value;
  });
  const plot = element("div", "plot", figure);
  const drawing = shape("svg", plot, { viewBox: `0 0 ${ACROSS} ${DOWN}`, preserveAspectRatio: "none", "aria-hidden": "true" });
  const x = (t) => ((ACROSS * t) / end).toFixed(2);
  const y = (value) => ((DOWN * (high - value)) / (high - low)).toFixed(2);
  const rectangle = (from, to, colour) =>
    shape("rect", drawing, { x: 0, width: ACROSS, y: y(to), height: y(from) - y(to) }, colour);
  const line = (d, width, colour, dash = "none") =>
    shape("path", drawing, { d, "stroke-width": width, "stroke-dasharray": dash }, colour);

  const [least, most] = panel.safe;
  const limits = panel.safe.filter((limit) => limit !== null);
  if (limits.length) {
    rectangle(low, high, "unsafe");
    rectangle(least ?? low, most ?? high, "safe");
  }
  for (const [t, text] of ticks(0, end, 5)) {
    line(`M${x(t)} 0V${DOWN}`, 1, "grid");
    element("span", "tick x", plot, `${text} s`).style.left = `${(100 * t) / end}%`;
  }
  for (const [value, text] of ticks(low, high, 4)) {
    line(`M0 ${y(value)}H${ACROSS}`, 1, "grid");
    element("span", "tick y", plot, text).style.top = `${y(value)}%`;
  }
  for (const limit of limits) line(`M0 ${y(limit)}H${ACROSS}`, 1, "text", "2 3");
  const step = (t, value) => (panel.held ? `H${x(t)}V${y(value)}` : `L${x(t)} ${y(value)}`);
  panel.lines.forEach((each, k) => {
    const path = each.values.map((value, row) => (row ? step(run.time[row], value) : `M${x(run.time[0])} ${y(value)}`));
    const [colour, width] = looks[k];
    line(path.join(""), width, colour);
  });
  const foot = y(low + FOOT * (high - low));
  const corrected = run.interventions[panel.acts] ?? [];
  line(corrected.map(([from, to]) => `M${x(from)} ${foot}H${x(to)}`).join(""), 6, "corrected");

  const cursor = element("div", "cursor", plot);
  const scrub = (event) => {
    const box = plot.getBoundingClientRect();
    if (event.buttons === 1) show(((event.clientX - box.left) / box.width) * end);
  };
  plot.addEventListener("pointerdown", scrub);
  plot.addEventListener("pointermove", scrub);

  const decimals = decimals_of(high - low);
  return (t) => {
    const row = rowAt(run, t);
    cursor.style.left = `${(100 * t) / end}%`;
    panel.lines.forEach((each, k) => {
      values[k].textContent = `${each.name} ${shortened(each.values[row], decimals)} `;
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

let time = 0;
let playing = false;
let lastFrame = 0;

function show(t) {
  time = Math.min(Math.max(t, 0), end);
  byId("scrub").value = time;
  byId("clock").textContent = `${time.toFixed(0)} s`;
  views.forEach((view) => view(time));
}

function play(wanted) {
  playing = wanted;
  byId("play").textContent = playing ? "❚❚ Pause" : "▶ Play";
  if (playing && time >= end) show(0);
}

function frame(now) {
  const elapsed = Math.min(now - lastFrame, 250) / 1000; // so that a tab that was hidden does not jump
  lastFrame = now;
  if (playing) show(time + elapsed * Number(byId("speed").value));
  if (playing && time >= end) play(false);
  requestAnimationFrame(frame);
}

function look(view) {
  byId("view").value = view;
  for (const film of films) if (film) film.view = view;
  show(time);
}

byId("scrub").max = end;
byId("scrub").addEventListener("input", (event) => show(Number(event.target.value)));
byId("play").addEventListener("click", () => play(!playing));
byId("view").addEventListener("change", (event) => look(event.target.value));
document.addEventListener("keydown", (event) => {
  const steps = { ArrowLeft: -data.step, ArrowRight: data.step };
  if (event.target.matches("select") || event.ctrlKey || event.altKey || event.metaKey) return;
  if (event.key === " " && !event.target.matches("button")) play(!playing);
  else if (event.key.toLowerCase() === "c") look(VIEWS[(VIEWS.indexOf(byId("view").value) + 1) % VIEWS.length]);
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
requestAnimationFrame(frame);
