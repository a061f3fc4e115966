"""Proximal policy optimisation (Schulman et al. 2017) of S independent seeds as one tensor program."""

import math
from collections.abc import Iterator, Sequence
from typing import Any

import torch
from torch import Tensor

from ppo.distributed import ALONE, Ranks
from ppo.divergence import KLPrice, divergence
from ppo.errors import NonFiniteError
from ppo.lagrangian import Multiplier
from ppo.network import Policy, Value, gaussian_entropy, gaussian_log_prob
from ppo.parameters import PPOParameters

MAX_LOG_RATIO = 20.0  # keeps e^x finite, also for actions that no agent draws, see `collect`
TRAINED_ON = ("observation", "action", "log_prob", "advantage", "return_")
KEYS = {"reward": "value", "cost": "cost_value"}  # keys in a checkpoint of the networks that predict these
OF_KL = ("mean", "log_std")  # of the collecting policy, needed if the divergence from it has a penalty
OF_COSTS = ("cost", "cost_advantage", "cost_return")  # in a batch, needed if costs have a limit


class PPO:
    """Trains S seeds: `policy`, `value` and `generators` (one per seed) must all have the same S.

    generators[k] orders the minibatches of seed k. Many `ranks` have equal networks and batches of their own; their
    gradients are averaged, so that all take the same steps. Errors count seeds from `first_seed`. `cost_value` predicts
    discounted costs: with it, PPO-Lagrangian keeps the mean cost per step at parameters.cost_limit. Raises ValueError
    if the numbers of seeds differ.
    """

    def __init__(
        self,
        policy: Policy,
        value: Value,
        parameters: PPOParameters,
        generators: Sequence[torch.Generator],
        ranks: Ranks = ALONE,
        first_seed: int = 0,
        cost_value: Value | None = None,
    ) -> None:
        self.policy = policy
        self.value = value
        self.parameters = parameters
        self.generators = generators
        self.ranks = ranks
        self.first_seed = first_seed
        self.critics = {"reward": value}  # keyed by the signal whose discounted sum they predict
        self.multiplier: Multiplier | None = None
        if cost_value is not None:
            self.critics["cost"] = cost_value
            device = next(cost_value.parameters()).device
            self.multiplier = Multiplier(parameters.cost_limit, len(generators), device)
        self.kl_price: KLPrice | None = None
        if parameters.kl_price:
            device = next(policy.parameters()).device
            self.kl_price = KLPrice(parameters.kl_price, parameters.kl_target, len(generators), device)
        self._named = {f"policy.{name}": weight for name, weight in policy.named_parameters()}
        for predicted, critic in self.critics.items():
            self._named |= {f"{KEYS[predicted]}.{name}": weight for name, weight in critic.named_parameters()}
        for name, weight in self._named.items():
            if len(weight) != len(generators):
                raise ValueError(f"{name} holds {len(weight)} seeds, but {len(generators)} generators came")
        self.optimiser = torch.optim.Adam(
            self._named.values(), lr=parameters.learning_rate, eps=1e-5, fused=True
        )

    def compile(self, samples: int) -> None:
        """Compiles the loss and its gradient for batches of `samples` per seed.

        On a CPU this needs a C++ compiler and is not faster. Raises as torch.compile, and then changes nothing.
        """
        compiled = torch.compile(self._loss, dynamic=False)
        first, *_, last = self.policy.network.layers
        shape = (len(self.generators), self._minibatch(samples)[1])
        rows = {name: first.weight.new_zeros(shape) for name in self._trained_on()}
        rows["observation"] = first.weight.new_zeros(*shape, self.value.network.layers[0].weight.shape[1])
        for name in {"action", *OF_KL} & set(rows):
            rows[name] = last.weight.new_zeros(*shape, last.weight.shape[2] // 2)
        compiled(rows)[0].sum().backward()  # compiles now, not in the first update
        self.optimiser.zero_grad()
        self._loss = compiled  # type: ignore[method-assign]

    def update(self, batch: dict[str, Tensor], progress: float) -> dict[str, Tensor]:
        """Trains on one batch and returns per-seed statistics (S,), averaged over the minibatches.

        `batch` holds float32 tensors: observation (S, N, observation_size), action (S, N, A), and log_prob, advantage,
        return_ and value (S, N), these four for the collecting policy. With a limit on costs it also holds cost,
        cost_advantage and cost_return (S, N). `progress` in [0, 1] is the share of training done. An epoch is ceil(N /
        minibatch_size) minibatches of equal size. The remainder of that division, fewer samples than there are
        minibatches, is left out of that epoch.

        The statistics: policy_loss, value_loss (mean squared error), entropy (nats), approx_kl (nats), clip_fraction,
        grad_norm (before clipping) and explained_variance (before the update); with a limit on costs also cost (mean
        per step), multiplier and cost_value_loss; with a penalty on the divergence also kl (nats) and kl_price.

        Raises ValueError for a progress outside [0, 1]. Raises NonFiniteError at the end of an update in which a loss
        or gradient was not finite: the weights are then unusable, and training must restart from a checkpoint.
        """
        if not 0.0 <= progress <= 1.0:
            raise ValueError(f"progress is {progress}: it must be in [0, 1]")
        rate = self.parameters.learning_rate * (1.0 - progress if self.parameters.anneal else 1.0)
        self.optimiser.param_groups[0]["lr"] = rate
        if self.kl_price:
            with torch.no_grad():
                batch = batch | dict(zip(OF_KL, self.policy(batch["observation"]), strict=True))
        for name in self._trained_on():
            require_finite(f"the batch's {name}", batch[name], self.first_seed)
        extra = {}
        if self.multiplier:
            extra["cost"] = batch["cost"].mean(1)
            self.ranks.average([extra["cost"]])
            self.multiplier.update(extra["cost"])
            extra["multiplier"] = self.multiplier.value
            # the advantage of r - lambda c; the loss normalises their sum
            priced = batch["advantage"] - self.multiplier.value[:, None] * batch["cost_advantage"]
            batch = batch | {"advantage": priced}
        rows = {name: batch[name].flatten(0, 1) for name in self._trained_on()}
        history: list[Tensor] = []
        for index in self.minibatches(batch["log_prob"].shape[1], batch["log_prob"].device):
            loss, statistics = self._loss({name: tensor[index] for name, tensor in rows.items()})
            self.optimiser.zero_grad()
            # with the sum over seeds, each seed's gradient is the one it would have alone
            with torch.autocast(loss.device.type, enabled=False):
                loss.sum().backward()
            self.ranks.average([gradient_of(weight) for weight in self._named.values()])
            statistics |= self._clip_gradients()
            self.optimiser.step()
            history.append(torch.stack(list(statistics.values())))
        steps = torch.stack(history)
        self.ranks.average([steps])
        mean = _finite_mean(steps, list(statistics), self.first_seed)
        for name, weight in self._named.items():
            require_finite(name, weight, self.first_seed)
        reported = {name: tensor for name, tensor in mean.items() if name not in self._named}
        if self.kl_price:
            reported["kl_price"] = self.kl_price.value
            self.kl_price.update(reported["kl"])
        reported |= extra
        # not finite where returns are equal
        unexplained = (batch["return_"] - batch["value"]).var(1) / batch["return_"].var(1)
        return reported | {"explained_variance": 1.0 - unexplained}

    def state_dict(self) -> dict[str, Any]:
        """Returns all that training changes, except the generators; tensors are shared, as PyTorch's are."""
        return {name: part.state_dict() for name, part in self._parts().items()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restores what state_dict returned; training then continues bit for bit."""
        for name, part in self._parts().items():
            part.load_state_dict(state[name])

    def _parts(self) -> dict[str, Any]:
        """Returns all parts that have a state, by their keys in a checkpoint."""
        parts: dict[str, Any] = {"policy": self.policy, "optimiser": self.optimiser}
        parts |= {KEYS[predicted]: critic for predicted, critic in self.critics.items()}
        parts |= {"multiplier": self.multiplier} if self.multiplier else {}
        return parts | ({"kl_price": self.kl_price} if self.kl_price else {})

    def _trained_on(self) -> tuple[str, ...]:
        """Returns the names of what a batch must hold to be trained on."""
        return TRAINED_ON + (OF_KL if self.kl_price else ()) + (OF_COSTS if self.multiplier else ())

    def _minibatch(self, samples: int) -> tuple[int, int]:
        """Returns how many minibatches an epoch has, and the samples of each."""
        count = math.ceil(samples / self.parameters.minibatch_size)
        return count, samples // count

    def minibatches(self, samples: int, device: torch.device) -> Iterator[Tensor]:
        """Yields for every minibatch of every epoch its rows (S, M) in a batch flattened to (S * N, ...)."""
        count, size = self._minibatch(samples)
        for _ in range(self.parameters.epochs):
            orders = [
                torch.randperm(samples, generator=generator, device=generator.device) + seed * samples
                for seed, generator in enumerate(self.generators)
            ]
            yield from torch.stack(orders).to(device)[:, : count * size].split(size, dim=1)

    def _loss(self, batch: dict[str, Tensor]) -> tuple[Tensor, dict[str, Tensor]]:
        """Returns the loss (S,) and statistics (S,), which carry no gradient, of a minibatch."""
        clip = self.parameters.clip
        mean_action, log_std = self.policy(batch["observation"])
        log_prob = gaussian_log_prob(batch["action"], mean_action, log_std)
        log_ratio = (log_prob - batch["log_prob"]).clamp(max=MAX_LOG_RATIO)
        ratio = log_ratio.exp()
        variance, mean = torch.var_mean(batch["advantage"], dim=1, correction=0, keepdim=True)
        advantage = (batch["advantage"] - mean) / (variance.sqrt() + 1e-8)
        # L_clip = -E[min(ratio A, clip(ratio, 1 - epsilon, 1 + epsilon) A)]   (2017, eq. 7)
        surrogate = torch.minimum(ratio * advantage, ratio.clamp(1.0 - clip, 1.0 + clip) * advantage)
        value_error = (self.value(batch["observation"]) - batch["return_"]).square()
        losses = {
            "policy_loss": -surrogate.mean(1),
            "value_loss": value_error.clamp(max=self.parameters.value_clip).mean(1),
            "entropy": gaussian_entropy(log_std).mean(1),
        }
        value_losses = losses["value_loss"]
        if self.multiplier:
            predicted = self.critics["cost"](batch["observation"])
            losses["cost_value_loss"] = (predicted - batch["cost_return"]).square().mean(1)
            value_losses = value_losses + losses["cost_value_loss"]
        # L = L_clip + c_v L_value - c_e H   (2017, eq. 9)
        loss = (
            losses["policy_loss"]
            + self.parameters.value_coefficient * value_losses
            - self.parameters.entropy_coefficient * losses["entropy"]
        )
        if self.kl_price:  # + beta KL(old || new)   (2017, eq. 8)
            losses["kl"] = divergence(batch["mean"], batch["log_std"], mean_action, log_std).mean(1)
            loss = loss + self.kl_price.value * losses["kl"]
        with torch.no_grad():
            statistics = {name: tensor.detach() for name, tensor in losses.items()}
            # KL(old || new) = E[(ratio - 1) - log ratio], unbiased and never negative
            statistics["approx_kl"] = (ratio - 1.0 - log_ratio).mean(1)
            statistics["clip_fraction"] = ((ratio - 1.0).abs() > clip).float().mean(1)
        return loss, statistics

    def _clip_gradients(self) -> dict[str, Tensor]:
        """Scales each seed's gradient to at most max_grad_norm; returns the norms (S,) before scaling.

        The critic of costs is scaled separately: a cost of 1 per step is a hundred times larger than a reward, and
        would leave almost no gradient to the other networks.
        """
        norms = {
            name: torch.linalg.vector_norm(gradient_of(weight), dim=(1, 2))
            for name, weight in self._named.items()
        }
        of_costs = [name for name in norms if name.startswith(KEYS["cost"])]
        others = [name for name in norms if name not in of_costs]
        reported = dict(norms)
        for names in filter(None, (of_costs, others)):
            total = torch.linalg.vector_norm(torch.stack([norms[name] for name in names]), dim=0)
            scale = (self.parameters.max_grad_norm / (total + 1e-6)).clamp(max=1.0)
            for name in names:
                gradient_of(self._named[name]).mul_(scale[:, None, None])
            reported["grad_norm"] = total
        return reported


def gradient_of(weight: Tensor) -> Tensor:
    """Returns the gradient that a backward pass left."""
    assert weight.grad is not None
    return weight.grad


def require_finite(name: str, tensor: Tensor, first_seed: int) -> None:
    """Raises NonFiniteError, naming the tensor (S, ...) and the first bad seed, unless the tensor is finite."""
    bad = ~torch.isfinite(tensor.flatten(1)).all(1)
    if bad.any():
        raise NonFiniteError(f"{name} is not finite (seed {first_seed + bad.nonzero()[0].item()})")


def _finite_mean(history: Tensor, names: list[str], first_seed: int) -> dict[str, Tensor]:
    """Averages (minibatches, names, S) over the minibatches; raises NonFiniteError at the first bad number."""
    bad = ~torch.isfinite(history)
    if bad.any():  # the only point of an update where the host waits for the device
        minibatch, name, seed = bad.nonzero()[0].tolist()
        raise NonFiniteError(
            f"{names[name]} is not finite (seed {first_seed + seed}, minibatch {minibatch} of the update)"
        )
    return dict(zip(names, history.mean(0), strict=True))
