# SPDX-License-Identifier: Apache-2.0
"""A network of two lines as a stereo matcher: |left - right| / 10 in place of a disparity."""

import sys

import numpy as np
import pytest

from stereovox.config import load_config
from stereovox.depth.stereo.matchers import make_matcher
from stereovox.errors import ConfigError, MissingExtra


def network(path, shape=(1, 1, "h", "w"), tail=(0, 1, 2, 3)):
    onnx = pytest.importorskip("onnx", reason="onnx makes the test's network (pip install 'stereovox[test]')")
    pytest.importorskip("onnxruntime", reason="networks run in onnxruntime (pip install 'stereovox[onnx]')")
    from onnx import TensorProto, helper

    image = [helper.make_tensor_value_info(name, TensorProto.FLOAT, shape) for name in ("left", "right")]
    nodes = [
        helper.make_node("Sub", ["left", "right"], ["difference"]),
        helper.make_node("Mul", ["difference", "tenth"], ["shorter"]),
        helper.make_node("ReduceMean", ["shorter"], ["mean"], axes=[1], keepdims=1),
        helper.make_node("Transpose", ["mean"], ["disparity"], perm=tail),
    ]
    out = helper.make_tensor_value_info("disparity", TensorProto.FLOAT, None)
    tenth = helper.make_tensor("tenth", TensorProto.FLOAT, [1], [0.1])
    graph = helper.make_graph(nodes, "stereo", image, [out], [tenth])
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8)
    onnx.save(model, str(path))
    return path


def images():
    random = np.random.default_rng(0)
    return random.integers(0, 255, (2, 45, 70), np.uint8)


def matcher(path, **settings):
    return make_matcher(load_config(**{"stereo.method": "onnx", "stereo.model": str(path), **settings}).stereo)


def wanted(left, right, most=128):
    value = (left.astype(float) - right) / 10
    return np.where((value >= 0) & (value <= most), value, np.nan)


@pytest.mark.parametrize("channels", [1, 3])
def test_free_and_fixed_sizes(tmp_path, channels):
    left, right = images()
    free = matcher(network(tmp_path / "free.onnx", (1, channels, "h", "w")))(left, right)
    np.testing.assert_allclose(free, wanted(left, right), rtol=1e-5)
    assert np.isnan(free).any()
    larger = matcher(network(tmp_path / "larger.onnx", (1, channels, 64, 96)))(left, right)
    np.testing.assert_allclose(larger, free, rtol=1e-6)
    smaller = matcher(network(tmp_path / "smaller.onnx", (1, channels, 32, 64)))(left, right)
    np.testing.assert_allclose(smaller[:32, :64], free[:32, :64], rtol=1e-6)
    assert np.isnan(smaller[32:]).all()
    assert np.isnan(smaller[:, 64:]).all()


def test_no_more_than_the_disparities_searched(tmp_path):
    left, right = images()
    found = matcher(network(tmp_path / "net.onnx"), **{"stereo.disparities": 16})(left, right)
    np.testing.assert_allclose(found, wanted(left, right, 16), rtol=1e-5)


def test_what_is_no_network_is_refused(tmp_path):
    with pytest.raises(ConfigError, match=r"set stereo\.model"):
        make_matcher(load_config(**{"stereo.method": "onnx"}).stereo)
    with pytest.raises(ConfigError, match="no such file"):
        matcher(tmp_path / "none.onnx")
    turned = network(tmp_path / "turned.onnx", tail=(0, 1, 3, 2))
    with pytest.raises(ConfigError, match="give a disparity of their size"):
        matcher(turned)(*images())
    with pytest.raises(ConfigError, match="takes two images"):
        matcher(network(tmp_path / "flat.onnx", ("c", "h", "w"), (0, 1, 2)))
    (tmp_path / "text.onnx").write_text("not a network")
    with pytest.raises(ConfigError, match="not an ONNX network") as error:
        matcher(tmp_path / "text.onnx")
    assert "\n" not in str(error.value)


def test_the_extra_is_named_where_it_is_missing(tmp_path, monkeypatch):
    (tmp_path / "net.onnx").write_text("")
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(MissingExtra, match=r"stereovox\[onnx\]"):
        matcher(tmp_path / "net.onnx")
