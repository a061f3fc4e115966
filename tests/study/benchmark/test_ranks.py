"""The measurements and the projection of docs/guides/scaling.md."""

import json
from pathlib import Path

import pytest

from settings import override
from study.benchmark import ranks
from study.config import Config


def test_a_process_measures_itself(tmp_path: Path) -> None:
    train = {"rta": False, "num_envs": 32, "rollout_steps": 4, "device": "cpu", "compile": "off"}
    config = override(Config(), {"train": train, "ppo": {"minibatch_size": 64, "epochs": 1}}, "test")
    ranks.main(tmp_path, config)
    (file,) = tmp_path.iterdir()
    result = json.loads(file.read_text())
    assert (file.name, result["ranks"]) == ("ranks_1.json", 1)
    assert result["bytes_per_exchange"] == 4 * (
        sum((n + 1) * m for n, m in ((26, 256), (256, 256), (256, 12)))
        + sum((n + 1) * m for n, m in ((26, 256), (256, 256), (256, 1)))
    )
    assert result["gradient_steps_per_update"] == 2
    for times in result["share_s"].values():
        assert list(times) == [str(count) for count in ranks.RANKS]
        assert min(times.values()) > 0.0


def test_projection_adds_up(capsys: pytest.CaptureFixture[str]) -> None:
    one = {
        "ranks": 1,
        "parameters": 1000,
        "bytes_per_exchange": 4000,
        "bytes_per_batch": 8000,
        "gradient_steps_per_update": 10,
        "rollout_steps": 5,
        "interactions_per_update": 100,
        "epochs": 2,
        "update_s": {"rollout_s": 5.0, "learning_s": 1.0},
        "share_s": {
            name: {str(count): 1.0 / count for count in ranks.RANKS}
            for name in ("environment_step", "gradient_step")
        },
    }
    two = one | {"ranks": 2, "exchange_s": {"gradient": 0.5, "latency": 0.1, "batch": 0.4, "turn": 0.01}}
    alone = ranks.update(one, two, 1, None)
    assert alone == {"rollout": 5.0, "gradients": 10.0, "exchanges": 0.0}
    pair = ranks.update(one, two, 2, None)
    assert pair["rollout"] == pytest.approx(2.5 + 5 * 0.01)
    # ten gradients as measured; the batch in one message of half its bytes, at 4000 bytes in 0.4 s
    assert pair["exchanges"] == pytest.approx(10 * 0.5 + 0.05 + 4000 / 10_000)
    # in a ring of 4: per gradient 6 messages of a quarter each; for the batch 3
    four = ranks.exchange(two, 4, 1000.0)
    assert four == pytest.approx(10 * (6 * 0.05 + 6 * 1.0) + 3 * 0.05 + 3 * 2.0)
    text = ranks.tables(one, two)
    assert "| 1 | 5.00 | 1.00 | 20 | 200 |" in text
    assert "| 1 | 5.00 | 10.00 | 0.00 | 7 | 7 | 7 | 7 |" in text
