import numpy as np
import pytest

from rsjax.tools.ingest.annotators.motion import RaftFlow, measure_motion
from tests.tools.ingest.videos import sliding

torch = pytest.importorskip("torch")
flows = pytest.importorskip("torchvision.models.optical_flow")


@pytest.fixture(scope="module")
def raft(tmp_path_factory):
    torch.manual_seed(0)
    file = tmp_path_factory.mktemp("raft") / "raft.pth"
    torch.save(flows.raft_small(weights=None).state_dict(), file)
    return RaftFlow(file, updates=2, batch=2)


def test_flow_has_the_pictures_size(raft):
    frames = sliding(4, (1, 0), (50, 70)).pictures
    field = raft(frames[:-1], frames[1:])
    assert field.shape == (3, 50, 70, 2) and field.dtype == np.float32 and np.isfinite(field).all()
    np.testing.assert_allclose(raft(frames[2:3], frames[3:]), field[2:], atol=1e-3)


def test_the_network_sees_minus_1_to_1_and_flow_is_in_the_pictures_pixels(raft, monkeypatch):
    class Network:
        def __call__(self, before, after, num_flow_updates):
            assert before.shape[1] == 3 and before.shape[2] % 8 == before.shape[3] % 8 == 0
            assert min(before.shape[2:]) >= 128 and num_flow_updates == 2
            assert -1 <= before.min() < -0.3 and 0.3 < before.max() <= 1
            flow = torch.ones(len(before), 2, *before.shape[2:])
            return [torch.zeros_like(flow), flow * torch.tensor([16.0, 8.0])[:, None, None]]

    monkeypatch.setattr(RaftFlow, "load", lambda self: Network())
    frames = sliding(2, (1, 0), (32, 64)).pictures  # becomes 128 × 128
    np.testing.assert_allclose(raft(frames[:1], frames[1:]), np.broadcast_to([8.0, 2.0], (1, 32, 64, 2)), rtol=1e-6)


def test_motion_is_measured_with_it(raft):
    motion = measure_motion(sliding(3, (1, 0), (40, 64)), np.arange(3.0), raft)
    assert motion.mean.shape == motion.high.shape == (3,) and (motion.high[1:] > 0).all()
