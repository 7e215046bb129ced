"""Runs the official CRA-PCN, at a quarter of its sizes, and writes the arrays that the
parity tests compare with.

    git clone https://github.com/EasyRy/CRA-PCN
    pip install torch
    python tests/golden/make_crapcn.py CRA-PCN

Every width and every count of points in the official ``models/crapcn.py`` is a literal
32, 64, 128, 256 or 512. They are divided by four as the file is read; nothing else of
it changes. ``stand_ins.py`` replaces the CUDA extensions. Weights are random, scaled so
that every layer's output has a standard deviation of about one. README.md beside this
file describes the arrays.
"""

import ast
import contextlib
import copy
import importlib
import itertools
import pathlib
import sys
import types

import numpy as np
import torch
from stand_ins import farthest_points, install

HERE = pathlib.Path(__file__).parent
SIZES = (32, 64, 128, 256, 512)
FULL_GRADIENTS = (
    "encoder.sa_module_1.mlp_conv.0.conv.weight",
    "encoder.crt_1.attn_lists.2.pos_mlp.0.weight",
    "encoder.crt_2.attn_lists.0.attn_mlp.3.weight",
    "encoder.sa_module_3.mlp_conv.1.conv.bias",
    "seed_generator.uptrans.attn_mlp.3.weight",
    "seed_generator.mlp_4.2.weight",
    "decoder.ub0.inter_crt.attn_lists.1.conv_key.weight",
    "decoder.ub1.deconv.ps.weight",
    "decoder.ub2.deconv.xyz_mlp.mlp.2.weight",
)


class Quarter(ast.NodeTransformer):
    """Divides the sizes by four."""

    def visit_Constant(self, node):
        if type(node.value) is int and node.value in SIZES:
            return ast.copy_location(ast.Constant(node.value // 4), node)
        return node


def load_official(folder):
    """The official modules ``(models.crapcn, utils.loss_utils_clamp)``, the network at
    a quarter of its sizes."""
    install()
    sys.path.insert(0, str(folder))
    tree = ast.parse((folder / "models" / "crapcn.py").read_text())
    network = types.ModuleType("models.crapcn")
    exec(compile(Quarter().visit(tree), "crapcn.py", "exec"), network.__dict__)
    return network, importlib.import_module("utils.loss_utils_clamp")


def clouds(rng):
    """Two partial clouds of 512 points and their complete ones of 4,096.

    The first has 230 distinct points; both have some that sampling skips.
    """

    def shell(count, half):
        points = rng.normal(size=(count, 3))
        points /= np.linalg.norm(points, axis=1, keepdims=True)
        if half:
            points[:, 2] = np.abs(points[:, 2])
        return points * [0.45, 0.2, 0.3]

    def slab(count):
        return rng.uniform(-1, 1, (count, 3)) * [0.12, 0.12, 0.01]

    few = np.concatenate([shell(180, True) + [0, 0.05, 0], slab(50)])
    repeated = few[np.concatenate([np.arange(230), rng.integers(0, 230, 282)])]
    partial = np.stack([repeated, np.concatenate([shell(412, True), slab(100)])])
    complete = np.stack([shell(4096, False) + [0, 0.05, 0], shell(4096, False)])
    return [torch.tensor(c, dtype=torch.float32) for c in (partial, complete)]


def target_scale(name):
    """Standard deviation that a layer's output is brought to: coordinates spread over
    a shape of 0.2, children stay near their parents."""
    if name == "seed_generator.mlp_4.2":
        return 0.25
    return 0.06 if name.endswith("deconv.xyz_mlp.mlp.2") else 1.0


def randomise(model, partial):
    """Fills the weights, layer by layer as the network runs, and rounds them to five
    bits and an exponent, which compress well."""
    hooks = contextlib.ExitStack()
    for name, module in model.named_modules():
        if isinstance(module, torch.nn.modules.batchnorm._BatchNorm):
            torch.nn.init.normal_(module.weight, 1.0, 0.2)
            torch.nn.init.normal_(module.bias, 0.0, 0.2)
            torch.nn.init.normal_(module.running_mean, 0.0, 0.2)
            torch.nn.init.uniform_(module.running_var, 0.5, 1.5)
        elif isinstance(module, torch.nn.modules.conv._ConvNd):
            torch.nn.init.normal_(module.weight)

            def rescale(module, inputs, output, scale=target_scale(name)):
                factor = scale / (output.std() * 1.02)
                module.weight.mul_(factor)
                output = output * factor
                if module.bias is not None:
                    torch.nn.init.normal_(module.bias, 0.0, 0.2 * scale)
                    output += module.bias.view(1, -1, *(1,) * (output.ndim - 2))
                return output

            if module.bias is not None:
                torch.nn.init.zeros_(module.bias)
            hooks.enter_context(module.register_forward_hook(rescale))
    with hooks:
        model(partial)
    for tensor in model.state_dict().values():
        if tensor.is_floating_point():
            mantissa, exponent = torch.frexp(tensor)
            tensor.copy_(torch.ldexp((32 * mantissa).round() / 32, exponent))


def is_steady(model, partial, complete, clamped):
    """Whether rounding changes no neighbour and no sampled point: weights that are a
    few ten-millionths off move no point by more than 1e-5, and no whole gradient by
    more than a thousandth."""

    def run(model):
        stages = model(partial)
        clamped.get_loss_clamp(stages, partial, complete)[0].backward()
        gradients = dict(model.named_parameters())
        return stages[-1].detach(), [gradients[name].grad for name in FULL_GRADIENTS]

    points, gradients = run(copy.deepcopy(model))
    for _ in range(3):
        moved = copy.deepcopy(model)
        with torch.no_grad():
            for weight in moved.parameters():
                weight.mul_(1 + 5e-7 * torch.randn_like(weight))
        other_points, other_gradients = run(moved)
        if (points - other_points).abs().max() > 1e-5:
            return False
        for a, b in zip(gradients, other_gradients, strict=True):
            if (a - b).abs().max() > 1e-3 * a.abs().max():
                return False
    return True


class Stages:
    """Stage-wise references: each stage runs in float64 on the float32 arrays that the
    stages before it have left."""

    def __init__(self):
        self.arrays = {}

    def keep(self, name, tensor):
        array = tensor.detach().numpy()
        self.arrays[name] = array.astype(
            np.int16 if array.dtype == np.int32 else np.float32
        )

    def get(self, *names):
        return [torch.tensor(self.arrays[name]).double() for name in names]

    def encoder(self, encoder, partial):
        xyz = partial.double().permute(0, 2, 1).contiguous()
        found = encoder.sa_module_1(xyz, xyz)
        for name, tensor in zip(("xyz", "sa", "knn"), found, strict=True):
            self.keep(f"ref/enc_l1_{name}", tensor)
        cloud = self.get("ref/enc_l1_xyz", "ref/enc_l1_sa")
        self.keep("ref/enc_l1_feat", encoder.crt_1(cloud, cloud)[0])
        found = encoder.sa_module_2(*self.get("ref/enc_l1_xyz", "ref/enc_l1_feat"))
        self.keep("ref/enc_l2_xyz", found[0])
        self.keep("ref/enc_l2_sa", found[1])
        xyz, sa = self.get("ref/enc_l2_xyz", "ref/enc_l2_sa")
        cloud = [xyz, encoder.conv_21(sa)]
        feature = encoder.conv_22(encoder.crt_2(cloud, cloud)[0]) + sa
        self.keep("ref/enc_l2_feat", feature)
        cloud = self.get("ref/enc_l2_xyz", "ref/enc_l2_feat")
        self.keep("ref/global_feat", encoder.sa_module_3(*cloud)[1])

    def seeds(self, generator, partial):
        patches = self.get("ref/enc_l2_xyz", "ref/enc_l2_feat")
        inputs = *self.get("ref/global_feat"), *patches, partial.double()
        seed, feature, _ = generator(*inputs)
        self.keep("ref/seed", seed)
        self.keep("ref/seed_feat", feature)
        joined = torch.cat([self.get("ref/seed")[0].mT, partial.double()], 1)
        rows = farthest_points(joined, partial.shape[1] // 4).long()
        initial = torch.gather(joined, 1, rows[..., None].expand(-1, -1, 3))
        self.keep("ref/p0", initial.mT)

    def block(self, number, block, query, support):
        """One up-sampling block; ``support`` names a cloud and its feature."""
        name = f"ref/ub{number}"
        query, feature = self.get(f"ref/{query}", "ref/global_feat")
        support = self.get(*(f"ref/{part}" for part in support))
        self.keep(f"{name}_pn", block.pn(query, feature))
        cloud = [query, *self.get(f"{name}_pn")]
        self.keep(f"{name}_inter", block.inter_crt(cloud, support)[0])
        cloud = [query, *self.get(f"{name}_inter")]
        self.keep(f"{name}_feat", block.intra_crt(cloud, cloud)[0])
        self.keep(f"{name}_xyz", block.deconv(query, *self.get(f"{name}_feat")))


def losses_and_gradients(model, partial, complete, clamped):
    """The loss in both norms, and the gradients of the unsquared one."""
    stages, arrays = model(partial), {}
    for name, root in (("sq", False), ("sqrt", True)):
        loss, parts = clamped.get_loss_clamp(stages, partial, complete, sqrt=root)[:2]
        values = [value.item() for value in (loss, *parts)]
        arrays[f"loss/clamp_{name}"] = np.array(values)
    loss.backward()
    gradients = {name: p.grad for name, p in model.named_parameters()}
    norms = [-1.0 if g is None else float(g.norm()) for g in gradients.values()]
    arrays["grad/norm_sqrt"] = np.array(norms)
    for key in FULL_GRADIENTS:
        arrays[f"grad/full_sqrt/{key}"] = gradients[key].numpy().astype(np.float32)
    return arrays | {"grad/names": np.array([*gradients])}


def training_mode(model, partial):
    """Seeds made with batch statistics, the running statistics after them, and over how
    many values each was taken."""
    arrays = {}
    norms = {
        name: module
        for name, module in model.named_modules()
        if isinstance(module, torch.nn.modules.batchnorm._BatchNorm)
    }
    with contextlib.ExitStack() as hooks, torch.no_grad():
        for name, module in norms.items():

            def count(module, inputs, output, key=f"train_mode/count/{name}"):
                arrays[key] = np.int32(inputs[0].numel() // inputs[0].shape[1])

            hooks.enter_context(module.register_forward_hook(count))
        seeds = model.train()(partial)[0]
    arrays["train_mode/out_0"] = seeds.numpy().astype(np.float32)
    for name, module in norms.items():
        if f"train_mode/count/{name}" in arrays:
            for kind in ("running_mean", "running_var"):
                array = getattr(module, kind).numpy().astype(np.float32)
                arrays[f"train_mode/stats/{name}.{kind}"] = array
    return arrays


def main():
    folder = pathlib.Path(sys.argv[1])
    network, clamped = load_official(folder)
    partial, complete = clouds(np.random.default_rng(0))
    pcn, sn55 = network.CRAPCN().eval(), network.CRAPCN_sn55().eval()
    for seed in itertools.count():
        torch.manual_seed(seed)
        with torch.no_grad():
            randomise(pcn, partial)
        given = partial.double(), complete.double()
        if is_steady(copy.deepcopy(pcn).double(), *given, clamped):
            break
    print(f"weights of seed {seed}")
    with torch.no_grad():
        randomise(sn55, partial)
    last = "decoder.ub2.deconv"
    weights = {k: v for k, v in pcn.state_dict().items() if not k.startswith(last)}
    sn55.load_state_dict(weights, strict=False)

    stages = Stages()
    double = copy.deepcopy(pcn).double()
    blocks = [double.decoder.ub0, double.decoder.ub1, double.decoder.ub2]
    with torch.no_grad():
        stages.encoder(double.encoder, partial)
        stages.seeds(double.seed_generator, partial)
        stages.block(0, blocks[0], "p0", ("seed", "seed_feat"))
        stages.block(1, blocks[1], "ub0_xyz", ("p0", "ub0_feat"))
        stages.block(2, blocks[2], "ub1_xyz", ("ub0_xyz", "ub1_feat"))
    arrays = stages.arrays | {"input": partial.numpy(), "gt": complete.numpy()}
    nested = clamped.fps_subsample(complete, partial.shape[1])
    arrays["gt_512"] = nested.numpy()
    arrays |= state(pcn, "") | outputs(pcn, double, partial)
    arrays |= losses_and_gradients(copy.deepcopy(double), *given, clamped)
    arrays |= training_mode(copy.deepcopy(double), partial.double())
    np.savez_compressed(HERE / "crapcn_pcn.npz", **arrays)

    double = copy.deepcopy(sn55).double()
    last_only = Stages()
    last_only.arrays = {k: v for k, v in stages.arrays.items() if "ub2" not in k}
    with torch.no_grad():
        inputs = "ub1_xyz", ("ub0_xyz", "ub1_feat")
        last_only.block(2, double.decoder.ub2, *inputs)
    kept = {"ref/ub2_xyz": last_only.arrays["ref/ub2_xyz"]}
    arrays = kept | state(sn55, last) | outputs(sn55, double, partial)
    np.savez_compressed(HERE / "crapcn_sn55.npz", **arrays)


def state(model, prefix):
    """The weights whose names begin with ``prefix``."""
    return {
        f"sd/{name}": tensor.numpy().astype(np.float16)
        for name, tensor in model.state_dict().items()
        if name.startswith(prefix) and not name.endswith("num_batches_tracked")
    }


def outputs(single, double, partial):
    """The plain runs from end to end, in float32 and in float64."""
    with torch.no_grad():
        runs = {"f32": single(partial), "f64": double(partial.double())}
    return {
        f"official_{precision}/out_{i}": stage.numpy().astype(np.float32)
        for precision, stages in runs.items()
        for i, stage in enumerate(stages)
    }


if __name__ == "__main__":
    main()
