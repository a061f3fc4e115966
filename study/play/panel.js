// What stands around the picture: keys, buttons, limits, numbers; and the clock that drives the flight.
"use strict";

const SPEEDS = [1, 2, 5, 10, 20, 50]; // seconds of the flight in a second
const MOST = 60; // seconds of the flight in one picture
const KEYS = { // by key: thrust or torque, its axis, its sign
  w: ["thrust", 0, 1], s: ["thrust", 0, -1], a: ["thrust", 1, 1], d: ["thrust", 1, -1], r: ["thrust", 2, 1], f: ["thrust", 2, -1],
  q: ["torque", 0, -1], e: ["torque", 0, 1], arrowup: ["torque", 1, -1], arrowdown: ["torque", 1, 1],
  arrowleft: ["torque", 2, 1], arrowright: ["torque", 2, -1],
};
const ALONG_ORBIT = { w: [1, 1], s: [1, -1], a: [0, -1], d: [0, 1], r: [2, 1], f: [2, -1] }; // axis of Hill's frame, sign
const STICKS = [["a", "d"], ["w", "s"], ["arrowleft", "arrowright"], ["arrowup", "arrowdown"]]; // of a gamepad, by axis
const BUTTONS = { 4: "q", 5: "e", 6: "f", 7: "r" }; // of a gamepad; its first one switches the filter
const AT_REST = 0.15; // of a stick
const STARTS = { 1: "ram", 2: "leaving", 3: "battery", 4: "random" };
const ENDS = {
  crash: ["Crash", "The deputy hit the chief."],
  out_of_bounds: ["Lost", "The deputy has left the zone, and does not come back."],
  out_of_power: ["Dead", "The battery is empty: no power, no command, no camera."],
  success: ["Done", "The chief is inspected."],
  timeout: ["Time is over", "Two orbits have passed."],
};

const $ = id => document.getElementById(id);
const task = JSON.parse($("data").textContent);
const pressed = new Set();
const play = { flight: null, scene: null, paused: true, speed: 10, ready: false, begun: 0, pushed: {}, cases: dice(Date.now()) };

function clock(seconds) {
  return `${Math.floor(seconds / 60)}:${String(Math.floor(seconds % 60)).padStart(2, "0")}`;
}

// starts and switches

function begin(name = $("start").value) {
  const { starts } = play.flight, cases = starts.filter(each => each.name.startsWith("case"));
  const start = name === "random" ? cases[Math.floor(play.cases() * cases.length)] : starts.find(each => each.name === name) || cases[0];
  play.flight.begin(start, task.worst ? play.begun++ % task.worst.plants.length : 0);
  if (play.scene) play.scene.begin(play.flight);
  $("end").hidden = true;
  play.left = 0;
  show();
}

function set_filter(on) {
  play.flight.filtered = on;
  $("filter").setAttribute("aria-pressed", on);
  $("filter").innerHTML = on ? "Safety filter ON <kbd>X</kbd>" : "Safety filter OFF <kbd>X</kbd>";
  show();
}

// the filter that is told of errors has a period of its own
function set_errors(worst) {
  play.flight.erring = worst;
  $("period").disabled = worst;
  $("period").value = worst ? task.worst.period : play.flight.period;
  $("about-errors").hidden = !worst;
}

function pause(still) {
  play.paused = still;
  $("pause").innerHTML = still ? "Go on <kbd>space</kbd>" : "Pause <kbd>space</kbd>";
}

function set_speed(place) {
  $("speed").value = place;
  play.speed = SPEEDS[$("speed").value];
  $("speed-value").textContent = `${play.speed} times`;
}

function next(id) {
  const select = $(id);
  select.selectedIndex = (select.selectedIndex + 1) % select.options.length;
  select.dispatchEvent(new Event("change"));
}

function welcomed() {
  if ($("welcome").hidden) return;
  $("welcome").hidden = true;
  pause(false);
}

function steer() {
  const { keys, axes } = play.flight;
  keys.thrust.fill(0);
  keys.torque.fill(0);
  const all = { ...play.pushed, ...Object.fromEntries([...pressed].map(key => [key, 1])) };
  for (const [key, strength] of Object.entries(all)) {
    let [kind, axis, sign] = KEYS[key];
    if (kind === "thrust" && axes === "hill") [axis, sign] = ALONG_ORBIT[key];
    keys[kind][axis] += sign * strength;
  }
  if (Object.keys(all).length && play.flight.pilot !== "you") { // whoever presses a key takes over
    $("pilot").value = play.flight.pilot = "you";
  }
}

// what sticks and buttons of a gamepad ask for, by the key that asks for the same
function read_gamepad() {
  const pad = Array.from(navigator.getGamepads ? navigator.getGamepads() : []).find(Boolean), pushed = {};
  if (!pad && !Object.keys(play.pushed).length) return;
  if (pad) {
    STICKS.forEach((sides, i) => {
      const along = pad.axes[i] || 0;
      if (Math.abs(along) > AT_REST) pushed[sides[along < 0 ? 0 : 1]] = Math.abs(along);
    });
    for (const [i, key] of Object.entries(BUTTONS)) {
      if (pad.buttons[i] && pad.buttons[i].value > AT_REST) pushed[key] = pad.buttons[i].value;
    }
    const switched = Boolean(pad.buttons[0] && pad.buttons[0].pressed);
    if (switched && !play.switched) set_filter(!play.flight.filtered);
    play.switched = switched;
  }
  if (Object.keys(pushed).length) welcomed();
  play.pushed = pushed;
  steer();
}

function press(key, down) {
  if (!(key in KEYS)) return false;
  if (down) pressed.add(key); else pressed.delete(key);
  steer();
  return true;
}

function on_key(event) {
  const key = event.key.toLowerCase(), down = event.type === "keydown";
  play.pointer = false;
  const typing = event.target.matches && event.target.matches("select, input, summary, button");
  if (event.ctrlKey || event.metaKey || event.altKey) return;
  if (typing && (key.startsWith("arrow") || key === " " || key === "enter") && $("welcome").hidden) return;
  if (press(key, down)) {
    if (down) welcomed();
    event.preventDefault();
    return;
  }
  if (!down || event.repeat) return;
  if (!$("welcome").hidden) {
    if (key === "enter" || key === " " || key === "escape") { welcomed(); event.preventDefault(); }
    return;
  }
  const place = Number($("speed").value);
  if (key === "x") set_filter(!play.flight.filtered);
  else if (key === " ") pause(!play.paused);
  else if (key === "n") begin();
  else if (key === "p") { $("assistant").click(); }
  else if (key === "c") next("view");
  else if (key === "v") next("pilot");
  else if (key === "+" || key === "=") set_speed(Math.min(place + 1, SPEEDS.length - 1));
  else if (key === "-") set_speed(Math.max(place - 1, 0));
  else if (key in STARTS) { $("start").value = STARTS[key]; begin(); }
  else return;
  event.preventDefault();
}

function listen() {
  addEventListener("keydown", on_key);
  addEventListener("keyup", on_key);
  // what a pointer has chosen does not keep the keys
  addEventListener("pointerdown", () => { play.pointer = true; });
  addEventListener("change", event => { if (play.pointer) event.target.blur(); });
  addEventListener("click", event => { if (play.pointer && event.target.closest("button")) document.activeElement.blur(); });
  addEventListener("blur", () => { pressed.clear(); steer(); });
  $("begin").onclick = welcomed;
  $("filter").onclick = () => set_filter(!play.flight.filtered);
  $("pause").onclick = () => pause(!play.paused);
  $("again").onclick = () => begin();
  $("start").onchange = () => begin();
  $("pilot").onchange = () => { play.flight.pilot = $("pilot").value; play.flight.held.until = -1; };
  $("period").onchange = () => { play.flight.period = Number($("period").value); };
  if (task.worst) $("errors").onchange = () => { set_errors($("errors").value === "worst"); begin(); };
  $("axes").onchange = () => { play.flight.axes = $("axes").value; steer(); };
  $("assistant").onchange = () => { play.flight.assistant = $("assistant").checked; };
  $("speed").oninput = () => set_speed($("speed").value);
  $("view").onchange = () => { if (play.scene) play.scene.view = $("view").value; };
  for (const button of document.querySelectorAll("#pad button")) {
    button.onpointerdown = event => { welcomed(); press(button.dataset.key, true); event.preventDefault(); };
    button.onpointerup = button.onpointercancel = button.onpointerleave = () => press(button.dataset.key, false);
    button.oncontextmenu = event => event.preventDefault();
  }
  $("save-settings").onclick = () => save("flight.toml", play.flight.settings);
  $("save-state").onclick = () => save("flight.json", play.flight.saved_state());
  $("save-controls").onclick = () => save("flight.npy", play.flight.saved_controls());
}

function save(name, content) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(new Blob([content]));
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 1000);
}

// what is shown

function bars() {
  play.bars = task.limits.map(limit => {
    const bar = document.createElement("div");
    bar.className = "bar";
    bar.title = limit.why;
    bar.innerHTML = "<p><span></span><span></span></p><i></i>";
    bar.querySelector("span").textContent = limit.title;
    $("bars").append(bar);
    return bar;
  });
}

function show_bars() {
  const { flight } = play;
  task.limits.forEach(({ scale, unit }, i) => {
    const bar = play.bars[i], h = flight.h[i], full = Math.max(0, Math.min(1, 1 - h / scale));
    bar.style.setProperty("--full", `${(100 * full).toFixed(1)}%`);
    bar.classList.toggle("close", full > 0.8);
    bar.classList.toggle("acts", flight.active[i] > 0);
    bar.classList.toggle("broken", !(h >= 0));
    bar.querySelectorAll("span")[1].textContent = h >= 0 ? margin(h, unit, full) : "violated";
  });
}

function margin(h, unit, full) {
  if (unit === "%") return `${(100 - 100 * full).toFixed(0)} %`;
  const size = unit === "\u00b0" ? h * 180 / Math.PI : h;
  return `${size.toFixed(size < 10 && unit !== "\u00b0" ? 2 : 0)}${unit === "\u00b0" ? "" : " "}${unit}`;
}

function show_status() {
  const { flight } = play, [status, , backup] = flight.answer;
  const acting = task.limits.filter((_, i) => flight.active[i] > 0).map(limit => limit.title.toLowerCase());
  const because = acting.length ? ` because of: ${acting.slice(0, 2).join(", ")}` : "";
  const found = !flight.filtered ? ["off", "The filter is off: every command is flown as it is."]
    : flight.missed ? ["corrected", "This call was missed: the last command is still flown."]
    : backup ? ["backup", `Backup: the deputy follows the way ${flight.worst ? "" : "to rest "}that was kept ready.`]
    : status === 0 ? ["", "Untouched: the command is safe and is flown as it is."]
    : status === 1 ? ["corrected", `Corrected${because || " to what the thrusters can do"}.`]
    : status === 2 ? ["backup", `A limit yields${because}.`]
    : ["backup", "No solution: the least bad command is flown."];
  $("status").className = found[0];
  $("status").textContent = found[1];
}

function show_end() {
  const { flight } = play;
  if (!flight.outcome) return;
  const [title, text] = ENDS[flight.outcome], good = flight.outcome === "success";
  $("end").className = good ? "success" : "";
  const fuel = good ? ` ${clock(flight.time)}, ${flight.deltaV.toFixed(1)} m/s of fuel.` : "";
  $("end").innerHTML = `<b>${title}</b>${text}${fuel}<br>Press <kbd>N</kbd> to fly again, <kbd>X</kbd> to switch the filter.`;
  $("end").hidden = false;
}

function show() {
  const { flight } = play, x = flight.state;
  show_bars();
  show_status();
  show_end();
  $("score").textContent = `${(100 * flight.score[0]).toFixed(0)} %`;
  $("delta-v").textContent = flight.deltaV.toFixed(2);
  $("time").textContent = clock(flight.time);
  $("distance").textContent = Math.hypot(x[0], x[1], x[2]).toFixed(0);
  $("moving").textContent = Math.hypot(x[3], x[4], x[5]).toFixed(2);
  const calls = flight.calls.reduce((sum, each) => sum + each, 0);
  $("calls").textContent = calls ? `${(100 * (1 - flight.calls[0] / calls)).toFixed(0)} %` : "\u2013";
  const broken = task.limits.filter(({ name }) => name in flight.broken).sort((a, b) => flight.broken[a.name] - flight.broken[b.name]);
  $("broken").replaceChildren(...broken.map(({ name, broken: text }) => {
    const item = document.createElement("li");
    item.textContent = `${clock(flight.broken[name])} ${text}`;
    return item;
  }));
  $("save-settings").hidden = !flight.settings;
  $("command").textContent = flight.command_again();
}

// the clock

function frame(now) {
  const { flight, scene } = play, passed = Math.min(0.25, (now - (play.last || now)) / 1000);
  play.last = now;
  read_gamepad();
  if (!play.paused && !flight.outcome) {
    play.left += passed * play.speed;
    const count = Math.min(Math.floor(play.left), MOST);
    for (let i = 0; i < count; i++) {
      flight.second();
      if (scene) scene.renew(flight);
    }
    play.left -= Math.floor(play.left);
    if (count) show();
  }
  if (scene) {
    const box = $("scene");
    if (box.clientWidth !== play.width || box.clientHeight !== play.height) {
      [play.width, play.height] = [box.clientWidth, box.clientHeight];
      scene.size(play.width, play.height);
    }
    scene.show(flight, flight.outcome ? 1 : play.left);
  }
  requestAnimationFrame(frame);
}

// packed, three.js has half the size
async function draw_with(base64) {
  const script = document.createElement("script");
  script.textContent = new TextDecoder().decode(await unpacked(base64));
  document.head.append(script);
}

async function main() {
  await draw_with($("three").textContent);
  play.flight = new Flight(await loaded($("module").textContent.trim()), task, Date.now());
  try {
    play.scene = new Picture($("scene"), task);
  } catch (error) { // no WebGL here
    $("nothing").hidden = false;
  }
  bars();
  listen();
  begin();
  set_filter(true);
  if (task.worst) set_errors(false);
  set_speed(3);
  pause(true);
  play.ready = true;
  requestAnimationFrame(frame);
}

main();
