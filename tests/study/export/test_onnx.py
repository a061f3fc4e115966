"""The exported agent: what it answers, what it says of itself, and when the command refuses."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnxruntime
import pytest
import torch

import main
from inspection.environment import InspectionEnv
from inspection.model.parameters import ChiefParameters, InspectionParameters
from inspection.observation import observe
from ppo.network import Policy
from settings import override
from study.config import Config
from study.experiment import load_policy, make_policy
from study.export import onnx as export
from study.flight.controllers import agent
from tests.test_main import call

C = InspectionParameters(max_thrust=2.0)
SHIPPED = Path(main.__file__).parent / "runs" / "reference" / "study" / "rta" / "seed0" / "policy.pt"


def untrained(**shape: float) -> Policy:
    """Returns an untrained agent whose actions are not small."""
    config = override(Config(), {"ppo": shape}, "test")
    policy = make_policy(config, [torch.Generator().manual_seed(0)])
    with torch.no_grad():
        policy.network.layers[-1].weight *= 100
        policy.network.layers[0].bias += 0.1
    return policy


def session_of(model: bytes) -> onnxruntime.InferenceSession:
    return onnxruntime.InferenceSession(model, providers=["CPUExecutionProvider"])


@pytest.mark.parametrize(("batch", "shape"), [(1, {}), (256, {"action_power": 1.5})])
def test_any_batch_is_answered_as_by_pytorch(batch: int, shape: dict[str, float]) -> None:
    policy = untrained(**shape)
    observation = torch.randn(batch, 26, generator=torch.Generator().manual_seed(1))
    (control,) = session_of(export.to_onnx(policy, C, ChiefParameters())).run(
        None, {"observation": observation.numpy()}
    )
    assert control.dtype == np.float32 and control.shape == (batch, 6)
    assert np.abs(control).max() > 0.5
    np.testing.assert_allclose(control, policy.mean_action(observation[None])[0], atol=1e-5)


def test_metadata_lead_from_a_state_to_newtons(random_states) -> None:
    """Observed in physical units and scaled as the file says, a state gets the control that a simulation gives it."""
    policy = untrained()
    session = session_of(export.to_onnx(policy, C, ChiefParameters()))
    about = {key: json.loads(text) for key, text in session.get_modelmeta().custom_metadata_map.items()}
    assert about["action_period"] == 10.0
    env = InspectionEnv(5, C, [torch.Generator().manual_seed(0)])
    env.reset()
    x = random_states(5)
    o = observe(x, env.sight.priority, env.sight.uninspected, env.sight.score(), C).T.numpy()
    divisors = np.array([component["scale"] for component in about["observation"]])
    (control,) = session.run(None, {"observation": (o / divisors).astype(np.float32)})
    scaled = control * np.array([component["scale"] for component in about["control"]])
    np.testing.assert_allclose(scaled.T, agent(policy, env)(0.0, x), atol=2e-5)


def test_metadata_lead_to_what_the_agent_observed_and_inspected(random_states) -> None:
    """Also where that depends on horizons and radii of its training, which are not the paper's."""
    c = replace(C, observed=("position", "free_flight"), free_flight_horizon=6000.0, deputy_radius=3.0)
    chief = ChiefParameters(mesh="configs/chiefs/box.npz", rate=(0.0, 0.1, 0.0), collision="sphere")
    about = export.metadata(c, chief)
    task, own = (
        {k: tuple(v) if isinstance(v, list) else v for k, v in json.loads(about[table]).items()}
        for table in ("inspection", "chief")
    )
    x, rest = random_states(5), [torch.zeros(3, 5).double()] * 2 + [torch.zeros(5).double()]
    seen = observe(x, *rest, InspectionParameters(**task))
    assert torch.equal(seen, observe(x, *rest, c))
    assert len(seen) == len(json.loads(about["observation"])) == 10
    assert not torch.equal(seen, observe(x, *rest, replace(C, observed=c.observed)))
    assert ChiefParameters(**own) == chief


def test_a_difference_ends_in_one_line_and_exit_code_1(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    policy, config = load_policy(SHIPPED)
    for weight in policy.parameters():
        weight.data *= 1.01
    other = export.to_onnx(policy, config.inspection, config.chief)
    monkeypatch.setattr(export, "to_onnx", lambda *_: other)
    out = tmp_path / "policy.onnx"
    code, _, err = call(["export", "--checkpoint", str(SHIPPED), "--out", str(out)], capsys)
    assert code == 1 and err.count("\n") == 1 and "differ from PyTorch's" in err
    assert not out.exists()
