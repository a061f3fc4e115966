// The picture of a flight: Hill's frame, x away from the Earth, y along the orbit, z up. The flight may be live or from
// a file: a page gives the points' kinds, the lines' points, and the spacecraft's position and attitude.
"use strict";

const COLOURS = { // Okabe and Ito's
  inspected: 0x009e73, lit: 0xe69f00, dark: 0x4a4f58, asked: 0xe69f00, flown: 0x56b4e9, cone: 0x56b4e9,
  keepOut: 0xd55e00, hull: 0xd55e00, zone: 0x56b4e9, ahead: 0xffffff, way: 0xf0e442, trail: 0x7a8798, earth: 0x2a5d9f,
};
const VIEWS = ["follow", "orbit", "onboard"];
const STAR_DISTANCE = 15000, SUN_DISTANCE = 12000, EARTH_DISTANCE = 11000; // not to scale
const LIGHT = 1000; // m, distance of the Sun's light from the chief
const BODY = 0x9aa0aa; // colour of the chief
const DEPUTY = 2.4; // m, size of its box if its radius with panels is DRAWN
const DRAWN = 5; // m
const MANY = 100; // more points than this are drawn smaller
const AROUND = 1.15; // in units of the least distance that shows a spacecraft on any side of the chief

// how a view is turned, and its distance in m; 0: the page's own distance
const first_looks = () => ({ follow: { yaw: 0.3, pitch: 0.25, distance: 38 }, orbit: { yaw: -0.9, pitch: 0.4, distance: 0 } });

class Scene {
  // task: the data of `drawn` in template.py, and in the chief's frame its `points`, each [x, y, z] in m, and `triangles`
  // and `hull`, null or corners of faces, one after another; looks: those of other scenes that turn with this one
  constructor(canvas, task, looks = first_looks()) {
    this.task = task;
    this.turned = () => {}; // a page can replace it to react to a turned or resized view
    this.renderer = new THREE.WebGLRenderer({ canvas, antialias: true, logarithmicDepthBuffer: true });
    this.renderer.outputEncoding = THREE.sRGBEncoding;
    this.scene = new THREE.Scene();
    this.scene.background = new THREE.Color(0x05070b);
    this.camera = new THREE.PerspectiveCamera(50, 1, 0.2, 40000);
    this.view = "follow";
    this.looks = looks;
    this.surroundings();
    this.chief();
    this.deputy();
    this.drag(canvas);
    new ResizeObserver(() => this.fit(canvas)).observe(canvas);
  }

  mesh(geometry, colour, more = {}, Material = THREE.MeshStandardMaterial) {
    return new THREE.Mesh(geometry, new Material({ color: linear(colour), ...more }));
  }

  see_through(geometry, colour, opacity, more = {}) {
    const material = { transparent: true, opacity, depthWrite: false, side: THREE.DoubleSide, ...more };
    return this.mesh(geometry, colour, material, THREE.MeshBasicMaterial);
  }

  surroundings() {
    const places = [];
    for (let i = 0; i < 1500; i++) {
      places.push(...new THREE.Vector3().randomDirection().multiplyScalar(STAR_DISTANCE).toArray());
    }
    const stars = new THREE.BufferGeometry();
    stars.setAttribute("position", new THREE.Float32BufferAttribute(places, 3));
    this.scene.add(new THREE.Points(stars, new THREE.PointsMaterial({ color: linear(0x9aa7b8), size: 1.5, sizeAttenuation: false })));
    this.light = new THREE.DirectionalLight(0xfff3e0, 1.45);
    this.scene.add(this.light, new THREE.AmbientLight(0x8899bb, 0.12));
    this.sun = this.mesh(new THREE.SphereGeometry(240, 32, 16), 0xfff6dd, {}, THREE.MeshBasicMaterial);
    const earth = this.mesh(new THREE.SphereGeometry(3600, 64, 32), COLOURS.earth, { roughness: 1 });
    earth.position.x = -EARTH_DISTANCE;
    this.scene.add(this.sun, earth);
  }

  chief() {
    const { chief_radius: radius, points, triangles, hull, collision_radius, max_distance } = this.task;
    const look = { roughness: 0.75, metalness: 0.15 };
    this.body_of_chief = triangles
      ? this.mesh(of_triangles(triangles), BODY, { ...look, flatShading: true, side: THREE.DoubleSide })
      : this.mesh(new THREE.SphereGeometry(0.985 * radius, 64, 32), BODY, look);
    const size = 0.055 * Math.max(...points.map(place => Math.hypot(...place)));
    const dot = new THREE.SphereGeometry(size * Math.min(1, Math.sqrt(MANY / points.length)), 10, 6);
    this.points = new THREE.InstancedMesh(dot, new THREE.MeshBasicMaterial(), points.length);
    points.forEach((place, i) => {
      this.points.setMatrixAt(i, new THREE.Matrix4().makeTranslation(...place));
      this.points.setColorAt(i, linear(COLOURS.dark));
    });
    this.points.frustumCulled = false;
    this.whole_chief = new THREE.Group();
    this.whole_chief.add(this.body_of_chief, this.points);
    if (hull) {
      const shape = of_triangles(hull), edges = new THREE.EdgesGeometry(shape);
      const look = { color: linear(COLOURS.hull), transparent: true, opacity: 0.5 };
      this.hull = this.see_through(shape, COLOURS.hull, 0.1);
      this.hull.add(new THREE.LineSegments(edges, new THREE.LineBasicMaterial(look)));
      this.whole_chief.add(this.hull);
    }
    if (triangles && triangles.length) this.shade(triangles);
    this.keepOut = this.see_through(new THREE.SphereGeometry(collision_radius, 24, 12), COLOURS.keepOut, 0, { wireframe: true });
    this.zone = this.see_through(new THREE.SphereGeometry(max_distance, 36, 18), COLOURS.zone, 0, { wireframe: true });
    this.scene.add(this.whole_chief, this.keepOut, this.zone);
  }

  // lets parts of a chief that is not a sphere cast shadows on others
  shade(triangles) {
    const reach = Math.max(...triangles.map(corner => Math.hypot(...corner)));
    this.renderer.shadowMap.enabled = true;
    this.body_of_chief.castShadow = this.body_of_chief.receiveShadow = this.light.castShadow = true;
    this.light.shadow.mapSize.set(2048, 2048);
    this.light.shadow.normalBias = 0.01 * reach;
    Object.assign(this.light.shadow.camera, { left: -reach, right: reach, bottom: -reach, top: reach, near: LIGHT - reach, far: LIGHT + reach });
  }

  // kinds: of each point "inspected", "lit" or "dark"
  colour(kinds) {
    kinds.forEach((kind, i) => this.points.setColorAt(i, linear(COLOURS[kind])));
    this.points.instanceColor.needsUpdate = true;
  }

  deputy() {
    const craft = this.craft = new THREE.Group(), body = this.body = new THREE.Group();
    body.add(this.mesh(new THREE.BoxGeometry(DEPUTY, DEPUTY, DEPUTY), 0xb8942a, { metalness: 0.2, roughness: 0.6 }));
    const lens = this.mesh(new THREE.CylinderGeometry(0.7, 0.85, 1, 24), 0x22262e, { metalness: 0.3, roughness: 0.3 });
    lens.rotation.z = -Math.PI / 2;
    lens.position.x = DEPUTY / 2 + 0.4;
    body.add(lens);
    const panels = this.task.solar_panel_axis, axis = "xyz".indexOf(panels[1]), sign = panels[0] === "-" ? -1 : 1;
    const wing = axis === 1 ? 0 : 1; // the axis along which they stick out
    for (const side of [-1, 1]) {
      const size = [2.2, 2.2, 2.2], place = [0, 0, 0];
      size[wing] = 3.4;
      size[axis] = 0.08;
      place[wing] = side * (DEPUTY / 2 + 1.9);
      place[axis] = 0.09 * sign; // the cells are on one side
      for (const [colour, at] of [[0x1b3f8b, place], [0x6d737c, place.map((each, i) => (i === axis ? 0 : each))]]) {
        const part = this.mesh(new THREE.BoxGeometry(...size), colour, { roughness: 0.6 });
        part.position.set(...at);
        body.add(part);
      }
    }
    const half = Math.tan(this.task.field_of_view / 2), cone = new THREE.ConeGeometry(half, 1, 48, 1, true);
    cone.translate(0, -0.5, 0);
    cone.rotateZ(Math.PI / 2); // from its tip along +x
    this.cone = this.see_through(cone, COLOURS.cone, 0.07, { blending: THREE.AdditiveBlending });
    body.scale.setScalar(this.task.deputy_radius / DRAWN);
    craft.add(body, this.cone);
    this.asked = this.arrow(COLOURS.asked, 0.36, 0.6);
    this.flown = this.arrow(COLOURS.flown, 0.17, 1);
    this.scene.add(craft, this.asked, this.flown);
  }

  // along +y, one metre long
  arrow(colour, radius, opacity) {
    const group = new THREE.Group();
    const shaft = this.see_through(new THREE.CylinderGeometry(radius, radius, 1, 16), colour, opacity);
    const tip = this.see_through(new THREE.ConeGeometry(2.6 * radius, 4.5 * radius, 20), colour, opacity);
    shaft.renderOrder = tip.renderOrder = 1 + opacity; // so that the thin arrow shows through the other
    group.add(shaft, tip);
    group.userData = { shaft, tip };
    return group;
  }

  point(arrow, from, direction, length) {
    arrow.visible = length > 0.3;
    if (!arrow.visible) return;
    const { shaft, tip } = arrow.userData;
    shaft.scale.y = length;
    shaft.position.y = length / 2;
    tip.position.y = length;
    arrow.position.copy(from);
    arrow.quaternion.setFromUnitVectors(new THREE.Vector3(0, 1, 0), direction.clone().normalize());
  }

  line(colour, opacity, count, dots = 0) {
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", new THREE.BufferAttribute(new Float32Array(3 * count), 3));
    geometry.setDrawRange(0, 0);
    const look = { color: linear(colour), transparent: true, opacity };
    const line = dots
      ? new THREE.Points(geometry, new THREE.PointsMaterial({ ...look, size: dots, sizeAttenuation: false }))
      : new THREE.Line(geometry, new THREE.LineBasicMaterial(look));
    line.frustumCulled = false;
    this.scene.add(line);
    return line;
  }

  fill(line, places, count) {
    line.geometry.attributes.position.array.set(places.subarray(0, 3 * count));
    line.geometry.attributes.position.needsUpdate = true;
    line.geometry.setDrawRange(0, count);
  }

  // draws the flight now: position p in m, attitudes q and chief from body axes to Hill's, scalar last, the Sun's angle
  // in rad, thrust desired and applied in N; from: m, distance from the chief that a view around it must show
  draw({ p: place, q: attitude, sun: angle, chief = [0, 0, 0, 1], desired, control, from = Math.hypot(...place) }) {
    const p = new THREE.Vector3(...place), q = new THREE.Quaternion(...attitude), distance = p.length();
    const sun = new THREE.Vector3(Math.cos(angle), Math.sin(angle), 0);
    this.craft.position.copy(p);
    this.craft.quaternion.copy(q);
    this.whole_chief.quaternion.set(...chief);
    this.cone.scale.setScalar(Math.max(8, Math.min(distance - this.task.chief_radius, 60)));
    this.light.position.copy(sun).multiplyScalar(LIGHT);
    this.sun.position.copy(sun).multiplyScalar(SUN_DISTANCE);
    this.keepOut.material.opacity = this.hull ? 0 : 0.22 * near(distance, 90, 25);
    this.zone.material.opacity = 0.1 * near(this.task.max_distance - distance, 250, 30);
    this.thrust(control, desired, p, q);
    this.look(p, q, from);
    this.renderer.render(this.scene, this.camera);
  }

  thrust(control, desired, p, q) {
    const most = this.task.max_thrust;
    const arrows = [[this.asked, desired], [this.flown, control]];
    for (const [arrow, u] of arrows) {
      const along = new THREE.Vector3(u[0], u[1], u[2]);
      this.point(arrow, p, along.clone().applyQuaternion(q), 11 * along.length() / most);
      arrow.visible = arrow.visible && this.view !== "onboard";
    }
  }

  look(p, q, from) {
    const { camera, view } = this, onboard = view === "onboard";
    this.body.visible = this.cone.visible = !onboard;
    camera.fov = onboard ? this.task.field_of_view * 180 / Math.PI : 50;
    if (onboard) {
      const ahead = new THREE.Vector3(1, 0, 0).applyQuaternion(q);
      camera.up.set(0, 0, 1).applyQuaternion(q);
      camera.position.copy(p).addScaledVector(ahead, DEPUTY / 2);
      camera.lookAt(camera.position.clone().add(ahead));
    } else {
      const { yaw, pitch, distance } = this.looks[view], up = new THREE.Vector3(0, 0, 1);
      const follow = view === "follow", back = follow ? p.clone().normalize() : new THREE.Vector3(1, 0, 0);
      const right = up.clone().cross(back);
      if (right.lengthSq() < 1e-4) right.set(0, 1, 0);
      right.normalize();
      const half = Math.atan(Math.tan(camera.fov * Math.PI / 360) * Math.min(1, camera.aspect)); // rad, half angle of the shorter side
      const over = back.clone().cross(right), r = distance || AROUND * from / Math.sin(half);
      const eye = back.multiplyScalar(Math.cos(yaw) * Math.cos(pitch)).addScaledVector(right, Math.sin(yaw) * Math.cos(pitch));
      eye.addScaledVector(over, Math.sin(pitch));
      const target = follow ? p.clone().multiplyScalar(1 - Math.min(16, 0.35 * p.length()) / p.length()) : new THREE.Vector3();
      camera.up.copy(follow ? over : up);
      camera.position.copy(target).addScaledVector(eye, r);
      camera.lookAt(target);
    }
    camera.updateProjectionMatrix();
  }

  fit({ clientWidth: width, clientHeight: height }) {
    if (!width) return;
    this.renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
    this.renderer.setSize(width, height, false);
    this.camera.aspect = width / height;
    this.turned();
  }

  // turns the view, angles in rad
  turn(yaw, pitch) {
    const look = this.looks[this.view];
    if (!look) return;
    look.yaw += yaw;
    look.pitch = Math.max(-1.5, Math.min(1.5, look.pitch + pitch));
    this.turned();
  }

  // changes the distance by a factor
  zoom(factor) {
    const look = this.looks[this.view];
    if (look) look.distance = Math.max(8, Math.min(4000, (look.distance || this.camera.position.length()) * factor));
    this.turned();
  }

  // turns and zooms the view with mouse or fingers
  drag(canvas) {
    const held = new Map(); // the position of each pointer
    const apart = () => {
      const [a, b] = [...held.values()];
      return Math.hypot(a.clientX - b.clientX, a.clientY - b.clientY);
    };
    canvas.addEventListener("pointerdown", event => {
      held.set(event.pointerId, event);
      canvas.setPointerCapture(event.pointerId);
    });
    for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, event => held.delete(event.pointerId));
    canvas.addEventListener("pointermove", event => {
      const last = held.get(event.pointerId), before = held.size === 2 ? apart() : 0;
      if (!last) return;
      held.set(event.pointerId, event);
      if (held.size === 1) this.turn(-0.006 * (event.clientX - last.clientX), 0.006 * (event.clientY - last.clientY));
      if (before && apart()) this.zoom(before / apart());
    });
    canvas.addEventListener("wheel", event => {
      this.zoom(Math.exp(0.001 * event.deltaY));
      event.preventDefault();
    }, { passive: false });
  }
}

// returns the shape of faces from their corners, one after another
function of_triangles(corners) {
  const shape = new THREE.BufferGeometry();
  shape.setAttribute("position", new THREE.Float32BufferAttribute(corners.flat(), 3));
  shape.computeVertexNormals();
  return shape;
}

// returns the numbers, or the attitude, a share of the way from one to another
function mixed(a, b, share) {
  return Array.from(a, (each, i) => each + share * (b[i] - each));
}

function turned(a, b, share) {
  return new THREE.Quaternion(...a).slerp(new THREE.Quaternion(...b), share).toArray();
}

// returns a colour as the renderer computes with it
function linear(hex) {
  return new THREE.Color(hex).convertSRGBToLinear();
}

// returns 0 at `far` and beyond, 1 at `close` and nearer, and a share between
function near(value, far, close) {
  return Math.max(0, Math.min(1, (far - value) / (far - close)));
}
