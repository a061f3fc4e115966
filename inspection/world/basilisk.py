"""Basilisk as the plant: chief and deputy on true orbits, in the simulator of the University of Colorado (bsk).

Our state is converted to Basilisk's and back, see `docs/guides/basilisk.md`. Basilisk integrates position, velocity,
attitude and body rates; temperature, energy and the Sun's angle follow from these.
"""

import math
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy import ndarray
from scipy.spatial.transform import Rotation
from torch import Tensor

from inspection.model.dynamics import resource_rates
from inspection.model.parameters import Limits
from inspection.model.state import OMEGA, THETA_S, THRUST, TORQUE, E, P, Q, T, V
from inspection.world.parameters import PlantParameters
from inspection.world.plant import Plant

EARTH_MU, EARTH_RADIUS, EARTH_J2 = 3.986004418e14, 6378136.3, 1.08262668e-3  # m^3/s^2, m, no unit: EGM96
INCLINATION = math.radians(51.6)  # of the chief's orbit, for J2; the node is in the Sun's direction

# The air at 800 km (Vallado 2013, Table 8-4): density in kg/m^3, height in m, and m over which density falls by e
AIR, AIR_BASE, AIR_SCALE = 1.17e-14, 800e3, 124.64e3
DRAG_COEFFICIENT = 2.2
CHIEF_AREA_PER_MASS = 0.01  # m^2/kg, typical of a satellite
DEPUTY_AREA = 0.06  # m^2, the long side of a 6U

RESOURCES = slice(T, E + 1)
PULSE = 0.02  # s; a thruster is open for a multiple of this time
# END: share of a pulse step by which a thruster closes early, because at the very end of a step rounding would decide.
# LOST: share of a step that RK4 then leaves out.
END, LOST = 0.25, 1 / 6
NOBODY = 1e9  # s, specific impulse so large that thrusters use no mass, as in the model


class Spacecraft(NamedTuple):
    """Holds a spacecraft of Basilisk, the places of its four states, and the objects by which it is acted on."""

    body: Any
    states: tuple[Any, ...]
    push: Any
    wheels: Any = None
    wheel_command: Any = None
    thruster_command: Any = None


class Simulation:
    """Simulates a batch of deputies, each with its chief, in one simulation of Basilisk.

    Args:
        dt: s, step of its RK4.
    """

    def __init__(self, batch: int, dt: float, parameters: PlantParameters, c: Limits) -> None:
        from Basilisk.utilities import SimulationBaseClass, macros

        self.parameters, self.c, self.nanoseconds = parameters, c, macros.sec2nano
        self.sim, self.now = SimulationBaseClass.SimBaseClass(), 0
        self.kept: list[Any] = []
        self.sim.CreateNewProcess("process").addTask(self.sim.CreateNewTask("task", macros.sec2nano(dt)))
        earth = self.earth()
        made = [self.spacecraft(name, i, earth) for i in range(batch) for name in ("chief", "deputy")]
        self.breathe([body for body, _ in made])
        self.sim.InitializeSimulation()
        found = [self.found(body, parts) for body, parts in made]
        self.chiefs, self.deputies = found[::2], found[1::2]

    def earth(self) -> Any:
        """Returns the Earth as a point mass, or flattened without the file that Basilisk would download."""
        from Basilisk.simulation import gravityEffector

        earth = gravityEffector.GravBodyData()
        earth.planetName, earth.isCentralBody = "earth_planet_data", True
        earth.mu, earth.radEquator = EARTH_MU, EARTH_RADIUS
        if self.parameters.j2:
            model = gravityEffector.SphericalHarmonicsGravityModel()
            model.maxDeg, model.muBody, model.radEquator = 2, earth.mu, EARTH_RADIUS
            normalised = -EARTH_J2 / math.sqrt(5)
            model.cBar = gravityEffector.MultiArray([[1.0, 0.0, 0.0], [0.0] * 3, [normalised, 0.0, 0.0]])
            model.sBar = gravityEffector.MultiArray([[0.0] * 3] * 3)
            model.initializeParameters()
            earth.gravityModel = model
        self.kept.append(earth)
        return earth

    def spacecraft(self, name: str, i: int, earth: Any) -> tuple[Any, dict[str, Any]]:
        """Returns a spacecraft that forces act on, the deputy also with wheels and thrusters if the settings ask so."""
        from Basilisk.simulation import extForceTorque, spacecraft

        body = spacecraft.Spacecraft()
        body.ModelTag = f"{name}{i}"
        body.hub.mHub, body.hub.IHubPntBc_B = self.c.mass, np.diag(self.c.inertia).tolist()
        body.gravField.gravBodies = spacecraft.GravBodyVector([earth])
        push = extForceTorque.ExtForceTorque()
        push.ModelTag = f"push_{name}{i}"
        body.addDynamicEffector(push)
        parts: dict[str, Any] = {"push": push}
        if name == "deputy" and self.parameters.actuators == "real":
            parts |= self.actuators(i, body)
        # a command before a step acts in this step, because Basilisk updates the effectors first
        self.sim.AddModelToTask("task", body, 10)
        self.sim.AddModelToTask("task", push, 20)
        return body, parts

    def actuators(self, i: int, body: Any) -> dict[str, Any]:
        """Returns a wheel and two thrusters along each body axis, through the centre of mass, with their commands."""
        from Basilisk.architecture import messaging
        from Basilisk.simulation import reactionWheelStateEffector, thrusterDynamicEffector
        from Basilisk.utilities import simIncludeRW, simIncludeThruster

        c = self.c
        wheels = reactionWheelStateEffector.ReactionWheelStateEffector()
        factory = simIncludeRW.rwFactory()
        for axis in np.eye(3).tolist():
            factory.create(
                "custom",
                axis,
                Omega=0.0,
                Js=c.wheel_inertia,
                u_max=c.wheel_inertia * c.max_wheel_acceleration,
                useRWfriction=False,
                RWModel=messaging.BalancedWheels,
            )
        factory.addToSpacecraft(f"wheels{i}", wheels, body)
        thrusters, nozzles = (
            thrusterDynamicEffector.ThrusterDynamicEffector(),
            simIncludeThruster.thrusterFactory(),
        )
        for direction in np.eye(3):
            for side in (direction, -direction):
                nozzles.create(
                    "Blank_Thruster",
                    [0.0] * 3,
                    side.tolist(),
                    MaxThrust=c.max_thrust,
                    thrusterMagDisp=0.0,
                    MinOnTime=0.0,
                    steadyIsp=NOBODY,
                    useMinPulseTime=False,
                )
        nozzles.addToSpacecraft(f"thrusters{i}", thrusters, body)
        torque, open_for = messaging.ArrayMotorTorqueMsg(), messaging.THRArrayOnTimeCmdMsg()
        wheels.rwMotorCmdInMsg.subscribeTo(torque)
        thrusters.cmdsInMsg.subscribeTo(open_for)
        for effector in (wheels, thrusters):
            self.sim.AddModelToTask("task", effector, 20)
        self.kept += [factory, nozzles, thrusters]
        return {"effector": wheels, "wheel_command": torque, "thruster_command": open_for}

    def breathe(self, bodies: list[Any]) -> None:
        """Adds air for chiefs and deputies, in turns, if drag is asked for."""
        if not self.parameters.drag:
            return
        from Basilisk.simulation import dragDynamicEffector, exponentialAtmosphere

        air = exponentialAtmosphere.ExponentialAtmosphere()
        air.planetRadius, air.baseDensity, air.scaleHeight = EARTH_RADIUS + AIR_BASE, AIR, AIR_SCALE
        self.sim.AddModelToTask("task", air, 30)
        self.kept.append(air)
        for i, body in enumerate(bodies):
            air.addSpacecraftToModel(body.scStateOutMsg)
            drag = dragDynamicEffector.DragDynamicEffector()
            area = DEPUTY_AREA if i % 2 else CHIEF_AREA_PER_MASS * self.c.mass
            drag.coreParams.projectedArea, drag.coreParams.dragCoeff = area, DRAG_COEFFICIENT
            drag.atmoDensInMsg.subscribeTo(air.envOutMsgs[i])
            body.addDynamicEffector(drag)
            self.sim.AddModelToTask("task", drag, 20)
            self.kept.append(drag)

    @staticmethod
    def found(body: Any, parts: dict[str, Any]) -> Spacecraft:
        """Returns a spacecraft with the places of its states, which exist only after the initialisation."""
        hub, manager = body.hub, body.dynManager
        names = hub.nameOfHubPosition, hub.nameOfHubVelocity, hub.nameOfHubSigma, hub.nameOfHubOmega
        effector = parts.pop("effector", None)
        if effector is not None:
            parts["wheels"] = manager.getStateObject(effector.nameOfReactionWheelOmegasState)
        return Spacecraft(body, tuple(manager.getStateObject(name) for name in names), **parts)

    def put(self, spacecraft: Spacecraft, *states: ndarray) -> None:
        """Sets position m and velocity m/s in the inertial frame, modified Rodrigues parameters, and rates rad/s."""
        for place, value in zip(spacecraft.states, states, strict=True):
            place.setState(value[:, None].tolist())

    def get(self, spacecraft: Spacecraft) -> list[ndarray]:
        """Returns what `put` sets."""
        return [np.ravel(place.getState()) for place in spacecraft.states]

    def act(self, i: int, u: ndarray, push: ndarray, body: ndarray, seconds: float) -> None:
        """Applies a control (6,) for some s and an inertial force in N to a deputy of mass and moments (4,)."""
        deputy = self.deputies[i]
        deputy.body.hub.mHub, deputy.body.hub.IHubPntBc_B = float(body[0]), np.diag(body[1:]).tolist()
        deputy.push.extForce_N = push[:, None].tolist()
        if deputy.wheels is None:
            deputy.push.extForce_B, deputy.push.extTorquePntB_B = (
                u[part, None].tolist() for part in (THRUST, TORQUE)
            )
            return
        from Basilisk.architecture import messaging

        command = messaging.ArrayMotorTorqueMsgPayload()
        command.motorTorque = (-u[TORQUE]).tolist()  # acts on the wheel; the reaction acts on the body
        deputy.wheel_command.write(command, self.now)
        steps = counted(u[THRUST], seconds, self.c)  # restores the part that is LOST
        pulses = PULSE * np.sign(steps) * (np.abs(steps) - END).clip(0.0)
        command = messaging.THRArrayOnTimeCmdMsgPayload()
        command.OnTimeRequest = np.stack((pulses, -pulses), 1).clip(0.0).ravel().tolist()
        deputy.thruster_command.write(command, self.now)


class BasiliskPlant(Plant):
    """Flies a `Plant` whose bodies Basilisk moves.

    Attributes:
        chief: (6, B) the chiefs' positions and velocities in an inertial frame; perturbations change them, too.
        wheels: (3, B) rad/s, of the reaction wheels relative to the body.
        rates: (2, B) of temperature and energy at the present states.

    `integrate` moves these three on with the states, and `state_dict` contains them. A state within a step is computed
    by our equations from the last state of Basilisk, without perturbations, wheels and pulses: see `Plant.read`.

    Raises:
        ImportError: Basilisk is not installed; ValueError: the parameters do not fit the model or the Earth.
    """

    STATE: tuple[str, ...] = (*Plant.STATE, "chief", "wheels", "rates")
    is_recordable = False

    def __init__(self, parameters: PlantParameters, c: Limits, batch: int, device: Any) -> None:
        super().__init__(parameters, c, batch, device)
        radius = orbit_radius(c)
        if radius <= EARTH_RADIUS:
            raise ValueError(
                f"mean_motion = {c.mean_motion:g}: puts the chief {radius / 1e3:,.0f} km from the Earth's centre: must "
                f"stay above its radius, {EARTH_RADIUS / 1e3:,.0f} km"
            )
        self.flattening = parameters.j2 * EARTH_J2 * EARTH_MU * EARTH_RADIUS**2
        self.chief = torch.zeros(6, batch, dtype=torch.float64, device=device)
        self.wheels = torch.zeros(3, batch, dtype=torch.float64, device=device)
        self.rates = torch.zeros(2, batch, dtype=torch.float64, device=device)
        self.frame: tuple[Tensor, Hill] | None = None  # the chiefs and their Hill frames after the last step
        import Basilisk.simulation  # noqa: F401

    def begin(self, columns: Tensor, x: Tensor, number: Tensor | None) -> None:
        """Begins episodes as `Plant.begin`; the chief's place on its orbit follows from the Sun's angle."""
        super().begin(columns, x, number)
        self.wheels[:, columns] = 0.0
        self.rates[:, columns] = torch.stack(resource_rates(x, self.c))
        self.frame = None  # the next line changes the chiefs in the same tensor
        self.chief[:, columns] = x.new_tensor(chief_in_space(x[THETA_S], self.c))

    @cached_property
    def simulation(self) -> Simulation:
        """Returns the simulation, made at the first step and for the length of this step."""
        return Simulation(self.key.numel(), self.dt, self.parameters, self.c)

    def actuate(self, time: Tensor, u: Tensor) -> Tensor:
        """Returns what acts, as `Plant.actuate`; for pulses the mean over a hold of the control."""
        acting = super().actuate(time, u)
        if self.parameters.actuators == "ideal":
            return acting
        steps = counted(acting[THRUST], self.acts_for, self.c)
        seconds = PULSE * steps.sign() * (steps.abs() - LOST).clamp(min=0.0)
        return torch.cat((self.c.max_thrust * seconds / self.acts_for, acting[TORQUE]))

    def integrate(self, x: Tensor, u: Tensor, body: Tensor, duration: float, times: int = 1) -> Tensor:
        """Returns the states (16, B) after `times` steps of `duration` s.

        Args:
            x: states (16, B); u: acting controls (6, B); body: the bodies (7, B).
        """
        real = self.parameters.actuators == "real"
        self.dt = PULSE if real else duration
        if real:  # pulses are counted over the whole time
            return self.step(x, u, body, duration * times)
        for _ in range(times):
            x = self.step(x, u, body, duration)
        return x

    def step(self, x: Tensor, u: Tensor, body: Tensor, seconds: float) -> Tensor:
        """Returns the states after some s; the body rates saturate if model and plant have them do so."""
        simulation = self.simulation
        before, chief, known = x.cpu().numpy(), self.chief.cpu().numpy(), self.frame
        bodies, controls, wheels = (part.cpu().numpy() for part in (body, u, self.wheels))
        frame = known[1] if known and known[0] is self.chief else hill(chief, self.flattening)
        deputies = frame.outwards(before)
        pushes = frame.axes.apply(bodies[4:].T) * bodies[:1].T
        for i, (home, deputy) in enumerate(zip(simulation.chiefs, simulation.deputies, strict=True)):
            simulation.put(home, chief[:3, i], chief[3:, i], np.zeros(3), np.zeros(3))
            simulation.put(deputy, *(part[i] for part in deputies))
            if deputy.wheels is not None:
                deputy.wheels.setState(wheels[:, i, None].tolist())
            simulation.act(i, controls[:, i], pushes[i], bodies[:4, i], seconds)
        # `ExecuteSimulation` would also look for events and draw a progress bar
        simulation.now += simulation.nanoseconds(seconds)
        simulation.sim.TotalSim.StepUntilStop(simulation.now, -1)
        chief = np.stack([np.concatenate(simulation.get(home)[:2]) for home in simulation.chiefs], 1)
        flown = [
            np.stack(part)
            for part in zip(*(simulation.get(each) for each in simulation.deputies), strict=True)
        ]
        after = x.clone()
        earlier, frame = frame, hill(chief, self.flattening)
        after[:13] = x.new_tensor(frame.inwards(*flown))
        radial, along_track, _ = earlier.axes.inv().apply(chief[:3].T).T  # the chief's way along its orbit
        after[THETA_S] = x[THETA_S] - x.new_tensor(np.arctan2(along_track, radial))
        if self.c.saturate_rates and self.parameters.saturate_rates:
            after[OMEGA] = after[OMEGA].clamp(-self.c.max_rate, self.c.max_rate)
        # Heun's method, with Basilisk's attitudes
        first = self.rates
        after[RESOURCES] = x[RESOURCES] + seconds * first
        self.rates = torch.stack(resource_rates(after, self.c))
        after[RESOURCES] = x[RESOURCES] + seconds / 2 * (first + self.rates)
        self.chief = x.new_tensor(chief)
        self.frame = self.chief, frame
        if simulation.deputies[0].wheels is not None:
            self.wheels = x.new_tensor(
                np.stack([np.ravel(each.wheels.getState()) for each in simulation.deputies], 1)
            )
        return after


def counted(thrust: Any, seconds: float, c: Limits) -> Any:
    """Returns how many pulses give a mean thrust in N, tensor or array, over some s; negative: the opposite side."""
    return (thrust / c.max_thrust * seconds / PULSE).round()


class Hill(NamedTuple):
    """Holds Hill's frames of k chiefs: states (6, k), axes in the inertial frame, and their rates in rad/s, (3, k)."""

    chief: ndarray
    axes: Rotation
    turning: ndarray

    def outwards(self, x: ndarray) -> tuple[ndarray, ...]:
        """Returns position, velocity, modified Rodrigues parameters, rates (k, 3) in the inertial frame."""
        attitude = self.axes * Rotation.from_quat(x[Q].T)
        r = self.chief[:3].T + self.axes.apply(x[P].T)
        v = self.chief[3:].T + self.axes.apply((x[V] + crossed(self.turning, x[P])).T)
        return r, v, attitude.as_mrp(), x[OMEGA].T

    def inwards(self, r: ndarray, v: ndarray, mrp: ndarray, omega: ndarray) -> ndarray:
        """Returns the first 13 components of our state, (13, k), rates relative to the stars; inverts `outwards`."""
        back = self.axes.inv()
        p = back.apply(r - self.chief[:3].T).T
        relative = back.apply(v - self.chief[3:].T).T - crossed(self.turning, p)
        q = (back * Rotation.from_mrp(mrp)).as_quat()
        return np.concatenate((p, relative, q.T, omega.T))


def hill(chief: ndarray, flattening: float = 0.0) -> Hill:
    """Returns Hill's frames for positions and velocities (6, k): x away from the Earth, z along the angular momentum.

    The frame turns about z at h / r^2, and about x at r a / h, where a acts across the orbit's plane (Casotto 2016).

    Args:
        flattening: J2 mu R^2 in m^5/s^2. Along the Earth's axis a is -3 J2 mu R^2 z / r^5 (Vallado 2013, Eq. 8-27); the
            other terms of that equation lie in the orbit's plane.
    """
    r, v = chief[:3], chief[3:]
    momentum = crossed(r, v)
    size, radius = np.sqrt((momentum * momentum).sum(0)), np.sqrt((r * r).sum(0))
    x, z = r / radius, momentum / size
    axes = np.stack((x, crossed(z, x), z), 1)  # columns are the axes
    across = -3.0 * flattening * r[2] / radius**5 * z[2]
    turning = np.stack((radius * across / size, 0.0 * radius, size / radius**2))
    return Hill(chief, Rotation.from_matrix(axes.transpose(2, 0, 1)), turning)


def crossed(a: ndarray, b: ndarray) -> ndarray:
    """Returns a x b of (3, k) each; NumPy's takes ten times as long for a single vector."""
    return np.stack((a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]))


def orbit_radius(c: Limits) -> float:
    """Returns the radius of the chief's orbit in m, by Kepler's third law."""
    return (EARTH_MU / c.mean_motion**2) ** (1 / 3)


def chief_in_space(theta_s: Tensor, c: Limits) -> ndarray:
    """Returns the chief's position and velocity (6, k) by the Sun's angle (k,); the Sun is along the inertial x."""
    radius = np.full(len(theta_s), orbit_radius(c))
    zero = 0.0 * radius
    angles = np.stack((-theta_s.cpu().numpy(), np.full_like(zero, INCLINATION)), 1)
    axes = Rotation.from_euler("zx", angles)  # turns along the orbit first, then by the inclination
    r = axes.apply(np.stack((radius, zero, zero), 1))
    return np.concatenate((r, axes.apply(np.stack((zero, radius * c.mean_motion, zero), 1))), 1).T
