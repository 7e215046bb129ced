import dataclasses
import sys
from collections import OrderedDict

import jax
import numpy as np
import pytest
from flax.traverse_util import flatten_dict

from experiments.baselines.crapcn import convert_state_dict, load_torch
from prism_jax.io.errors import InputError
from prism_jax.models.backbone import init_backbone
from prism_jax.models.config import PCN, SHAPENET55, BackboneConfig, ModelConfig

# No two widths that meet in one layer are equal.
TINY = BackboneConfig(
    num_points=64,
    patch_points=(32, 16),
    patch_features=((5, 8), (9, 12)),
    global_features=(10, 14),
    patch_neighbors=4,
    features=8,
    attention_features=6,
    attention_ratio=3,
    num_neighbors=(4, 3),
    encoder_rates=(1, 2),
    level_rates=((1, 2), (1, 4)),
    num_initial=32,
    up_factors=(1, 3),
)


def torch_shapes(config):
    """Names and shapes of the official state dict, as its documentation lists them."""
    shapes = {}
    width, inner = config.features, config.attention_features
    hidden, (wide, end) = config.attention_ratio * inner, config.patch_features[1]
    global_width = config.global_features[1]

    def conv(name, outputs, inputs, axes=1):
        shapes[f"{name}.weight"] = (outputs, inputs) + (1,) * axes
        shapes[f"{name}.bias"] = (outputs,)

    def norm(name, size):
        for array in ("weight", "bias", "running_mean", "running_var"):
            shapes[f"{name}.{array}"] = (size,)
        shapes[f"{name}.num_batches_tracked"] = ()

    def residual(name, inputs, middle, outputs):
        conv(f"{name}.conv_1", middle, inputs)
        conv(f"{name}.conv_2", outputs, middle)
        conv(f"{name}.conv_shortcut", outputs, inputs)

    def attention(name, inputs):
        for layer in ("conv_key", "conv_query", "conv_value"):
            conv(f"{name}.{layer}", inner, inputs)
        conv(f"{name}.pos_mlp.0", inner, 3, 2)
        norm(f"{name}.pos_mlp.1", inner)
        conv(f"{name}.pos_mlp.3", inner, inner, 2)
        conv(f"{name}.attn_mlp.0", hidden, inner, 2)
        norm(f"{name}.attn_mlp.1", hidden)
        conv(f"{name}.attn_mlp.3", inner, hidden, 2)
        conv(f"{name}.conv_end", width, inner)

    def transformer(name, levels):
        for i in range(levels):
            attention(f"{name}.attn_lists.{i}", width)
        for i in range(levels - 1):
            residual(f"{name}.q_mlp_lists.{i}", 2 * width, width, width)
            residual(f"{name}.s_mlp_lists.{i}", 2 * width, width, width)

    abstractions = (
        (6, *config.patch_features[0]),
        (3 + width, wide, end),
        (3 + end, *config.global_features),
    )
    for i, widths in enumerate(abstractions, 1):
        for j in range(2):
            layer = f"encoder.sa_module_{i}.mlp_conv.{j}"
            conv(f"{layer}.conv", widths[j + 1], widths[j], 2)
            norm(f"{layer}.bn", widths[j + 1])
    transformer("encoder.crt_1", len(config.encoder_rates))
    transformer("encoder.crt_2", len(config.encoder_rates))
    conv("encoder.conv_21", width, end)
    conv("encoder.conv_22", end, width)

    seeds = "seed_generator"
    attention(f"{seeds}.uptrans", end)
    shapes[f"{seeds}.uptrans.attn_mlp.3.weight"] = (hidden, inner, config.seed_times, 1)
    conv(f"{seeds}.uptrans.residual_layer", width, end)
    residual(f"{seeds}.mlp_1", width + global_width, width, width)
    residual(f"{seeds}.mlp_2", width, width // 2, width)
    residual(f"{seeds}.mlp_3", width + global_width, width, width)
    conv(f"{seeds}.mlp_4.0", width // 2, width)
    conv(f"{seeds}.mlp_4.2", 3, width // 2)

    for i, times in enumerate(config.up_factors):
        block = f"decoder.ub{i}"
        conv(f"{block}.pn.mlp_1.mlp.0", width // 2, 3)
        conv(f"{block}.pn.mlp_1.mlp.2", width, width // 2)
        conv(f"{block}.pn.mlp_2.mlp.0", 4 * width, 2 * width + global_width)
        conv(f"{block}.pn.mlp_2.mlp.2", 2 * width, 4 * width)
        conv(f"{block}.pn.mlp_2.mlp.4", width, 2 * width)
        transformer(f"{block}.inter_crt", len(config.level_rates[i]))
        transformer(f"{block}.intra_crt", len(config.level_rates[i]))
        conv(f"{block}.deconv.decrease_dim.mlp.0", width // 2, width)
        norm(f"{block}.deconv.decrease_dim.mlp.1", width // 2)
        conv(f"{block}.deconv.decrease_dim.mlp.3", width // 4, width // 2)
        shapes[f"{block}.deconv.ps.weight"] = (width // 4, width, times)
        residual(f"{block}.deconv.mlp_res", 2 * width, width, width)
        conv(f"{block}.deconv.xyz_mlp.mlp.0", width // 2, width)
        conv(f"{block}.deconv.xyz_mlp.mlp.2", 3, width // 2)
    return shapes


@pytest.fixture(scope="module")
def state_dict():
    """Every number of the tiny network is another one."""
    state, start = {}, 0
    for name, shape in torch_shapes(TINY).items():
        size = int(np.prod(shape))
        state[name] = np.arange(start, start + size, dtype=np.float32).reshape(shape)
        start += size
    return state


def unused(name):
    return ".bn." in name or name.endswith("num_batches_tracked")


@pytest.mark.parametrize(
    ("config", "num_parameters"),
    [
        (TINY, None),
        (PCN, 7471212),
        pytest.param(SHAPENET55, 7454828, marks=pytest.mark.slow),
    ],
)
def test_gives_the_variables_of_the_modules(config, num_parameters):
    state = {n: np.zeros(s, np.float16) for n, s in torch_shapes(config).items()}
    converted = flatten_dict(convert_state_dict(state, config))
    model = ModelConfig(config)
    key = jax.random.key(0)
    expected = jax.eval_shape(lambda key: init_backbone(key, model.backbone), key)
    expected = flatten_dict(expected)
    assert {p: a.shape for p, a in converted.items()} == {
        p: a.shape for p, a in expected.items()
    }
    assert all(array.dtype == np.float32 for array in converted.values())
    if num_parameters:
        # The published count includes the 12 vectors of BatchNorms never applied.
        dropped = sum(
            array.size
            for name, array in state.items()
            if name.endswith((".bn.weight", ".bn.bias"))
        )
        params = (a.size for path, a in converted.items() if path[0] == "params")
        assert sum(params) + dropped == num_parameters


@pytest.mark.parametrize("variant", ["pcn", "sn55"])
def test_the_list_of_names_is_the_published_one(published, variant):
    network = published(variant)
    actual = {name: array.shape for name, array in network.state_dict().items()}
    listed = torch_shapes(network.config).items()
    assert actual == {n: s for n, s in listed if "num_batches" not in n}


def test_every_number_arrives_once(state_dict):
    converted = flatten_dict(convert_state_dict(state_dict, TINY)).values()
    arrived = np.sort(np.concatenate([array.ravel() for array in converted]))
    sent = [a.ravel() for name, a in state_dict.items() if not unused(name)]
    np.testing.assert_array_equal(arrived, np.sort(np.concatenate(sent)))


def test_layouts(state_dict):
    converted = convert_state_dict(state_dict, TINY)
    params, stats = converted["params"], converted["batch_stats"]
    encoder, decoder = params["point_encoder"], params["decoder"]

    def check(actual, expected):
        np.testing.assert_array_equal(actual, expected)

    reduce = state_dict["encoder.conv_21.weight"]
    check(encoder["reduce"]["kernel"], reduce[:, :, 0].T)
    check(encoder["reduce"]["bias"], state_dict["encoder.conv_21.bias"])
    last = encoder["transformer_2"]["attention_1"]["attention_1"]["kernel"]
    name = "encoder.crt_2.attn_lists.1.attn_mlp.3.weight"
    check(last, state_dict[name][:, :, 0, 0].T)

    split = decoder["block_1"]["split"]["dense"]["kernel"]
    weight = state_dict["decoder.ub1.deconv.ps.weight"]
    upsample = decoder["seed_generator"]["upsample"]["attention_1"]
    kernel = state_dict["seed_generator.uptrans.attn_mlp.3.weight"]
    for child in range(3):
        check(split[:, child], weight[:, :, child])
    for child in range(2):
        check(upsample["dense"]["kernel"][:, child], kernel[:, :, child, 0])
    check(upsample["bias"], state_dict["seed_generator.uptrans.attn_mlp.3.bias"])

    name = "decoder.ub0.deconv.decrease_dim.mlp.1"
    check(decoder["block_0"]["norm"]["scale"], state_dict[f"{name}.weight"])
    check(decoder["block_0"]["norm"]["bias"], state_dict[f"{name}.bias"])
    norm = stats["decoder"]["block_0"]["norm"]
    check(norm["mean"], state_dict[f"{name}.running_mean"])
    check(norm["var"], state_dict[f"{name}.running_var"])


def same(a, b):
    return jax.tree.all(jax.tree.map(np.array_equal, a, b))


def test_wrapped_checkpoints(state_dict):
    expected = convert_state_dict(state_dict, TINY)
    parallel = {f"module.{name}": array for name, array in state_dict.items()}
    for checkpoint in (
        {"epoch_index": 3, "best_metrics": 6.39, "model": parallel},
        {"base_model": OrderedDict(state_dict), "optimizer": {}},
        {n: a for n, a in parallel.items() if "num_batches" not in n},
    ):
        assert same(convert_state_dict(checkpoint, TINY), expected)


def test_faults_are_named(state_dict):
    def message(state, config=TINY):
        with pytest.raises(ValueError) as caught:
            convert_state_dict(state, config)
        return str(caught.value)

    name = "decoder.ub1.deconv.ps.weight"
    without = {n: a for n, a in state_dict.items() if n != name}
    assert f"{name} is missing" in message(without)
    unused_one = "encoder.sa_module_3.mlp_conv.1.bn.running_var"
    without = {n: a for n, a in state_dict.items() if n != unused_one}
    assert f"{unused_one} is missing" in message(without)
    assert "decoder.more is unexpected" in message(
        state_dict | {"decoder.more": np.zeros(1)}
    )
    misshapen = message(state_dict | {name: state_dict[name][..., :2]})
    assert f"{name} has shape (2, 8, 2)" in misshapen
    assert "(2, 8, 3)" in misshapen
    transposed = state_dict["encoder.conv_21.weight"].swapaxes(0, 1)
    assert "encoder.conv_21" in message(
        state_dict | {"encoder.conv_21.weight": transposed}
    )
    assert "more" in message({})
    assert len(message({})) < 500
    assert "use_norm" in message(state_dict, BackboneConfig(use_norm=False))
    assert "seeds" in message(state_dict, BackboneConfig(seeds_from_patches=True))


def test_load_torch(state_dict, tmp_path):
    torch = pytest.importorskip("torch")
    path = tmp_path / "ckpt-best.pth"
    tensors = {f"module.{n}": torch.from_numpy(a) for n, a in state_dict.items()}
    torch.save({"epoch_index": 1, "best_metrics": 6.39, "model": tensors}, path)
    assert same(load_torch(path, TINY), convert_state_dict(state_dict, TINY))
    torch.save(OrderedDict(tensors), path, _use_new_zipfile_serialization=False)
    assert same(load_torch(str(path), TINY), convert_state_dict(state_dict, TINY))


def test_load_torch_faults(state_dict, tmp_path):
    torch = pytest.importorskip("torch")

    def message(path, config=TINY):
        with pytest.raises(InputError) as caught:
            load_torch(path, config)
        line = str(caught.value)
        assert line.startswith(str(path)) and "\n" not in line and len(line) < 700
        return line

    path = tmp_path / "weights.pth"
    assert "no such file" in message(path)
    assert "not a file" in message(tmp_path)
    path.write_text("not a checkpoint")
    assert "not a PyTorch checkpoint" in message(path)
    torch.save({n: torch.from_numpy(a) for n, a in state_dict.items()}, path)
    other_variant = dataclasses.replace(TINY, up_factors=(1, 2))
    assert "decoder.ub1.deconv.ps.weight has shape" in message(path, other_variant)
    data = path.read_bytes()
    for damaged in (data[: len(data) // 2], data[:100], data[-1000:]):
        path.write_bytes(damaged)
        assert "not a PyTorch checkpoint" in message(path)
    torch.save([1, 2], path)
    assert "not a state dict" in message(path)


def test_load_torch_runs_nothing(tmp_path):
    torch = pytest.importorskip("torch")
    written = tmp_path / "written"

    class Command:
        def __reduce__(self):
            return open, (str(written), "w")

    path = tmp_path / "weights.pth"
    torch.save({"model": Command()}, path)
    with pytest.raises(InputError, match="tensors only"):
        load_torch(path, TINY)
    assert not written.exists()


def test_absent_torch_names_the_extra(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(InputError, match=r"prism_jax\[torch\]"):
        load_torch(tmp_path / "weights.pth", TINY)
