"""From photographs, and what a network saved of their cameras and points, to a COLMAP project.

What the network saw, resized, cut or padded, is reconciled with the photographs. Where these show
that the poses are of another form, they are set right; where features match, a bundle adjustment
refines them, and the network's points move with the cameras that see them.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from pathlib import Path, PurePosixPath

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from torch import Tensor

from gvtools.cameras import Cameras, Float64, invert_rigid, rigid_poses
from gvtools.capture.mapping import Say, shared_points
from gvtools.capture.photographs import CapturedPhotograph, copy_upright, find_photographs
from gvtools.capture.predictions import Predictions, read_predictions, sample_points
from gvtools.capture.project import (
    IMAGES,
    MODEL,
    REPORT,
    CaptureReport,
    camera_rows,
    place,
    replaced_folder,
)
from gvtools.completers.geoverse.views import model_size, resample
from gvtools.depth.options import FoundationOptions
from gvtools.errors import OptionError, ProjectError
from gvtools.files import write_json
from gvtools.networks.compute import autocast, inference_type
from gvtools.networks.depth_anything.network import load_depth_anything
from gvtools.poses.bundle_adjustment import MOST_VIEWS, Tracks, adjusted_poses, refine_focals
from gvtools.scenes.colmap import read_colmap
from gvtools.scenes.colmap_writer import build_reconstruction, write_colmap
from gvtools.scenes.images import IMAGE_SUFFIXES, read_image
from gvtools.scenes.matching import is_hidden, named
from gvtools.scenes.pose_forms import pose_contradiction, pose_findings
from gvtools.scenes.resized import reduced
from gvtools.scenes.scene import Finding, Scene

Pictures = NDArray[np.uint8]
Size = tuple[int, int]  # width and height [px]

# Memory of Depth Anything 3 grows with the square of the pictures in a pass.
MOST_PICTURES = 64
# Longer side of the pictures in which features are found for the adjustment [px].
SIDE = 800
# Networks round sides to patches of 14 or 16 [px].
PATCH, LARGEST_PATCH = 14, 16
# The network's pictures differ by less from the photographs that they show [grey levels], of which
# so many are looked at.
SAME, COMPARED = 25.0, 6
# Focal lengths of one camera's pictures that spread by less than this share are taken for one.
ONE_FOCAL = 0.2
# Poses of a network miss by so much: matches lie on their lines below it [px of a small picture].
NEAR = 8.0
# How photographs become a network's pictures; "width" and "height" scale that side to its own and
# round the other to patches, and what is too large or too small is cut or padded at the middle.
FITS = ("stretch", "cover", "contain", "width", "height")


def capture_posed(
    source: Path,
    out: Path,
    *,
    poses: Path,
    distance: tuple[str, str, float] | None = None,
    say: Say = lambda text: None,
    draw: Callable[[Path, CaptureReport], object] = lambda folder, report: None,
) -> CaptureReport:
    """Write a project of photographs and what a network saved of them.

    Args:
        source: folder of the photographs that the network saw.
        out: the project's folder; absent or empty.
        poses: what the network saved, a file or a folder, see ``predictions``; or a folder of Depth
            Anything 3's weights, by which it is computed.
        distance: names of two pictures and the distance between their places, metres.
        draw: adds pictures to the project's folder before it gets its name.
    """
    if not source.is_dir():
        raise OptionError(f"--poses: {source} is no folder; expected the pictures the network saw")
    # Where a network's program, its weights and what it saved lie together, the last is meant.
    is_network = any(poses.rglob("*.safetensors")) and not any(poses.rglob("*.np[yz]"))
    predictions = None if is_network else read_predictions(poses)
    with replaced_folder(out) as work:
        photographs, findings = find_photographs(source)
        sideways = [item.name for item in photographs if item.turned]
        if sideways:
            raise ProjectError(
                f"{source}: {len(sideways)} photographs are stored on their side "
                f"({named(sideways)}), which some networks heed and some do not; save them upright "
                "and run the network on these"
            )
        if predictions is None:
            say(f"running Depth Anything 3 on {len(photographs)} photographs")
            predictions = _predict(photographs, poses)
        rows, met = _rows(predictions, photographs, source=source, poses=poses)
        kept = [item for item in photographs if item.name in rows]
        copy_upright(kept, work / IMAGES)
        given = predictions.cameras[[rows[item.name] for item in kept]]
        scaled, cut = _scaled_sizes(predictions, kept, given, rows=rows, poses=poses)
        cameras = _reconciled(kept, given, scaled)
        say(f"comparing the poses with {len(kept)} photographs")
        cameras, scene, forms = _right_form(cameras, work)
        say("adjusting the poses to features of neighbouring pictures")
        adjusted, tracks, how = _adjusted(cameras, scene)
        # What is left once features had their say.
        forms += [] if len(tracks.point) else pose_findings(scene)
        view, xy, points = _seen_points(predictions, cameras, adjusted, scaled=scaled, rows=rows)
        both = np.concatenate([tracks.view, view]), np.concatenate([tracks.xy, xy])
        point = np.concatenate([tracks.point, len(tracks.positions) + np.arange(len(view))])
        _, first = np.unique(point, return_index=True)
        model = build_reconstruction(
            adjusted, np.concatenate([tracks.positions, points]),
            np.zeros((len(first), 3), np.uint8), point_index=point, view_index=both[0], xy=both[1],
        )  # fmt: skip
        model.extract_colors_for_all_images(str(work / IMAGES))
        locations = {item.name: item.location for item in kept if item.location}
        placement, placed = place(model, locations=locations, distance=distance)
        model.write_binary(str(work / MODEL))
        errors = tracks.reprojection_errors(adjusted, adjusted.cam_from_world)
        report = CaptureReport(
            source=str(source.resolve()),
            pictures=len(photographs),
            registered=adjusted.names,
            left_out={i.name: f"no camera in {poses}" for i in photographs if i not in kept},
            reprojection_px=float(errors.mean()) if len(errors) else None,
            points=len(model.points3D),
            track_length=len(point) / max(len(first), 1),
            explained=None,
            mapping=f"{poses.name}, {how}",
            features="sift",
            matching="neighbours by their poses",
            other_models=(),
            overlap=tuple((*pair, count) for pair, count in sorted(shared_points(model).items())),
            cameras=camera_rows(model),
            metric=placement.metric,
            placed_by=placement.by,
            origin=placement.origin,
            findings=(*findings, *predictions.findings, *met, *cut, *forms, *placed),
        )
        write_json(work / REPORT, asdict(report))
        draw(work, report)
    return report


@torch.no_grad()
def _predict(photographs: Sequence[CapturedPhotograph], weights: Path) -> Predictions:
    """Cameras and depth by Depth Anything 3, of photographs of about one aspect, in one pass."""
    if len(photographs) > MOST_PICTURES:
        raise OptionError(
            f"--poses {weights}: {len(photographs)} pictures; one pass takes at most "
            f"{MOST_PICTURES}; give fewer, or what the network's own program saved"
        )
    place = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    dtype = inference_type("auto", place)
    network = load_depth_anything(weights, device=place, dtype=dtype)
    width, height = np.median([item.size for item in photographs], axis=0)
    size = model_size(
        int(height), int(width), longest=FoundationOptions().longest,
        patch=network.config.encoder.patch,
    )  # fmt: skip
    pictures = [torch.from_numpy(read_image(item.path).rgb) for item in photographs]
    small = torch.cat([
        resample(rgb.permute(2, 0, 1)[None].float() / 255, size) for rgb in pictures
    ]).clamp(0, 1)  # fmt: skip
    with autocast(place, dtype):
        levels = network.encode(small[None].to(place))
        geometry = network.geometry(levels, network.encoder.grid(*size))
        encoding = network.cam_dec(levels[-1][:, :, 0])
    names = tuple(item.name for item in photographs)
    depth, sure = (
        array[0].float().cpu().numpy() for array in (geometry.depth, geometry.depth_confidence)
    )
    cameras = decode_cameras(encoding[0], size, names=names)
    shown = (small.permute(0, 2, 3, 1) * 255).byte().numpy()
    return Predictions(cameras, True, shown, True, *sample_points(depth, sure))


def decode_cameras(encoding: Tensor, size: tuple[int, int], *, names: tuple[str, ...]) -> Cameras:
    """Cameras of (V, 9) encodings, see ``encode_cameras``; ``size`` is height and width [px]."""
    values = encoding.double().cpu().numpy()
    pose = rigid_poses(Rotation.from_quat(values[:, 3:7]).as_matrix(), values[:, :3])
    K = np.tile(np.eye(3), (len(values), 1, 1))
    half = np.array(size[::-1]) / 2
    K[:, :2, 2] = half
    K[:, [0, 1], [0, 1]] = half / np.tan(np.clip(values[:, [8, 7]], 0.05, 3.0) / 2)
    return Cameras.alike(K, invert_rigid(pose), size=(size[1], size[0]), names=names)


def _rows(
    predictions: Predictions, photographs: Sequence[CapturedPhotograph], *, source: Path,
    poses: Path,
) -> tuple[dict[str, int], list[Finding]]:  # fmt: skip
    """The network's camera of each photograph: that of its name, or of its place in the folder."""
    count, there = len(predictions.cameras), [item.name for item in photographs]
    if not predictions.has_names:
        names = [path.relative_to(source).as_posix() for path in source.rglob("*")]
        # As networks list folders: by names as text.
        order = sorted(
            name for name in names
            if PurePosixPath(name).suffix.lower() in IMAGE_SUFFIXES and not is_hidden(name)
        )  # fmt: skip
        if len(order) != count:
            raise ProjectError(
                f"--poses {poses}: {count} cameras without names, and {source} holds {len(order)} "
                "pictures; expected one camera for each; give the folder that the network saw"
            )
        text = f"{poses} names no pictures: its cameras are those of {named(order)}, in this order"
        rows = {name: row for row, name in enumerate(order) if name in there}
        return rows, [Finding("info", text)]
    keys: tuple[Callable[[str], str], ...] = (
        str, lambda name: PurePosixPath(name).name, lambda name: PurePosixPath(name).stem
    )  # fmt: skip
    for key in keys:
        own, told = (Counter(map(key, names)) for names in (there, predictions.cameras.names))
        number = {key(name): row for row, name in enumerate(predictions.cameras.names)}
        rows = {name: number[key(name)] for name in there if own[key(name)] == told[key(name)] == 1}
        if len(rows) > 1:
            text = (
                f"{count - len(rows)} of {count} cameras of {poses} are of no picture of {source}"
            )
            return rows, [Finding("warning", text)] if count > len(rows) else []
    raise ProjectError(
        f"--poses {poses}: cameras of {named(predictions.cameras.names)}; expected names of "
        f"pictures of {source}, as {named(there)}"
    )


def _scaled(fit: str, photo: Size, net: Size) -> tuple[float, float]:
    """Width and height of a whole photograph in the pixels of what the network saw of it."""
    (width, height), (w, h) = photo, net
    if fit == "stretch":
        return w, h
    if fit == "width":
        return w, max(PATCH, round(height * w / width / PATCH) * PATCH)
    if fit == "height":
        return max(PATCH, round(width * h / height / PATCH) * PATCH), h
    scale = (max if fit == "cover" else min)(w / width, h / height)
    return width * scale, height * scale


def _shown(rgb: NDArray[np.uint8], net: Size, fit: str) -> Pictures:
    """(2, h, w, 3) what a network sees of a photograph under a fit, padded in black and white."""
    scale = np.array(_scaled(fit, (rgb.shape[1], rgb.shape[0]), net)) / rgb.shape[1::-1]
    shift = (np.array(net) - scale * rgb.shape[1::-1]) / 2 + scale / 2 - 0.5
    small = cv2.blur(rgb, [max(1, round(1 / side)) for side in scale])
    matrix = np.column_stack([np.diag(scale), shift])
    return np.stack([
        cv2.warpAffine(small, matrix, net, borderValue=(tone,) * 3) for tone in (0, 255)
    ]).astype(np.uint8)  # fmt: skip


def _difference(shown: Pictures, picture: NDArray[np.uint8]) -> float:
    """By how much a network's picture differs from what it is shown [grey levels]."""
    return float(np.minimum(*(cv2.absdiff(each, picture) for each in shown)).mean())


def _fit_of(
    pictures: Pictures, items: Sequence[CapturedPhotograph], rows: dict[str, int], *, poses: Path
) -> str:
    """The fit under which photographs are the network's pictures, each its own."""
    height, width = pictures.shape[1:3]
    looked = [items[row] for row in np.unique(np.linspace(0, len(items) - 1, COMPARED).round(0))
              .astype(int)]  # fmt: skip
    shown = {fit: [_shown(read_image(item.path).rgb, (width, height), fit) for item in looked]
             for fit in FITS}  # fmt: skip
    own = [pictures[rows[item.name]] for item in looked]
    errors = {fit: np.median(list(map(_difference, shown[fit], own))) for fit in FITS}
    fit = min(FITS, key=lambda fit: errors[fit])
    if errors[fit] > SAME:
        raise ProjectError(
            f"--poses {poses}: its pictures differ from the photographs by {errors[fit]:.0f} "
            f"grey levels, expected at most {SAME:.0f}; give the folder that the network saw"
        )
    small = [_reduced(picture) for picture in pictures]
    for item, pair in zip(looked, shown[fit], strict=True):
        apart = [_difference(np.stack(list(map(_reduced, pair))), other) for other in small]
        if 2 * min(apart) < apart[rows[item.name]]:
            raise ProjectError(
                f"--poses {poses}: its picture {rows[item.name] + 1} is to be {item.name}, which "
                f"looks like number {np.argmin(apart) + 1}; expected the order of names as text; "
                "rename the photographs so that this is the order in which the network saw them"
            )
    return fit


def _reduced(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return np.asarray(cv2.resize(picture, (32, 32), interpolation=cv2.INTER_AREA), np.uint8)


def _scaled_sizes(
    predictions: Predictions, items: Sequence[CapturedPhotograph], given: Cameras, *,
    rows: dict[str, int], poses: Path,
) -> tuple[Float64, list[Finding]]:  # fmt: skip
    """(V, 2) sizes of whole photographs in the network's pixels, by its pictures or by sizes."""
    nets: list[Size] = list(zip(given.width.tolist(), given.height.tolist(), strict=True))
    fits = {}
    for size in {item.size for item in items}:
        if predictions.pictures is not None:
            alike = [item for item in items if item.size == size]
            fits[size] = _fit_of(predictions.pictures, alike, rows, poses=poses)
    near = predictions.stretched and all(
        abs(w / item.size[0] * item.size[1] - h) < LARGEST_PATCH
        for item, (w, h) in zip(items, nets, strict=True)
    )
    guess = "stretch" if near else "cover"
    sizes = np.array([
        _scaled(fits.get(item.size, guess), item.size, net)
        for item, net in zip(items, nets, strict=True)
    ])  # fmt: skip
    if fits or [item.size for item in items] == nets:
        return sizes, []
    of = f"{poses} is of pictures of {nets[0][0]}x{nets[0][1]} pixels"
    if not predictions.has_names and np.ptp(sizes.max(axis=1)) > LARGEST_PATCH:
        raise ProjectError(
            f"--poses {of}, and the photographs are of several shapes: how each was cut is not "
            "told; expected the network's pictures as well (Depth Anything 3: --export-format npz)"
        )
    how = "stretched" if near else "reduced and cut"
    return sizes, [Finding("info", f"{of}: the photographs are taken to have been {how} to it")]


def _reconciled(items: Sequence[CapturedPhotograph], given: Cameras, scaled: Float64) -> Cameras:
    """The cameras of the photographs: one K, the median, for one camera's, where they agree."""
    photo, K = np.array([item.size for item in items]), given.K.copy()
    K[:, :2, 2] -= (np.column_stack([given.width, given.height]) - scaled) / 2
    K[:, :2] *= (photo / scaled)[..., None]
    for camera in {item.camera for item in items}:
        mine = [row for row, item in enumerate(items) if item.camera == camera]
        if np.ptp(K[mine, 0, 0]) <= ONE_FOCAL * np.median(K[mine, 0, 0]):
            K[mine] = np.median(K[mine], axis=0)
    names = tuple(item.name for item in items)
    return Cameras(K, given.cam_from_world, photo[:, 0], photo[:, 1], names)


def _right_form(cameras: Cameras, work: Path) -> tuple[Cameras, Scene, list[Finding]]:
    """The cameras with poses of the form that the photographs confirm, and their scene."""
    write_colmap(work / MODEL, cameras)
    scene = read_colmap(work)
    found = pose_contradiction(scene, near=NEAR)
    if found is None or found.form is None:
        return cameras, scene, []
    poses = np.stack([found.form(pose) for pose in cameras.cam_from_world])
    cameras = replace(cameras, cam_from_world=poses)
    write_colmap(work / MODEL, cameras)
    return cameras, read_colmap(work), [Finding("warning", f"{found.message}: done")]


def _adjusted(cameras: Cameras, scene: Scene) -> tuple[Cameras, Tracks, str]:
    """Cameras on which features agree, their tracks [px of the photographs], and how, in words."""
    none = np.zeros(0, np.int64)
    nothing = Tracks(np.zeros((0, 3)), none, none, np.zeros((0, 2)))
    if len(scene) > MOST_VIEWS:
        return cameras, nothing, f"as saved: more than {MOST_VIEWS} pictures are not adjusted"
    small = reduced(scene, SIDE)
    found = adjusted_poses([view.load() for view in small.views], small.cameras)
    if found is None:
        return cameras, nothing, "as saved: features tell no better poses"
    scale = np.column_stack([
        cameras.width / small.cameras.width, cameras.height / small.cameras.height
    ])  # fmt: skip
    tracks = replace(found.tracks, xy=found.tracks.xy * scale[found.tracks.view])
    after, tracks = refine_focals(replace(cameras, cam_from_world=found.poses), tracks)
    before, now = found.errors
    return after, tracks, f"bundle-adjusted: median error {before:.2f} to {now:.2f} px"


def _seen_points(
    predictions: Predictions, cameras: Cameras, adjusted: Cameras, *, scaled: Float64,
    rows: dict[str, int],
) -> tuple[NDArray[np.int64], Float64, Float64]:  # fmt: skip
    """Of the network's points the view, the place in it [px], and that in the adjusted world."""
    number = np.full(len(predictions.cameras), -1)
    number[[rows[name] for name in cameras.names]] = np.arange(len(cameras))
    view, photo = number[predictions.view], np.column_stack([cameras.width, cameras.height])
    net = np.column_stack([predictions.cameras.width, predictions.cameras.height])
    middle = predictions.xy - net[predictions.view] / 2
    xy = (middle / scaled[view] + 0.5) * photo[view]
    z = predictions.points
    if z.ndim > 1:
        pose = cameras.cam_from_world[view]
        z = np.einsum("mj,mj->m", pose[:, 2, :3], z) + pose[:, 2, 3]
    use = (view >= 0) & (xy >= 0).all(axis=1) & (xy < photo[view]).all(axis=1) & (z > 0)
    view, xy, z = view[use], xy[use], z[use]
    rays = np.column_stack([xy, np.ones(len(xy))])
    rays = np.einsum("mij,mj->mi", np.linalg.inv(adjusted.K)[view], rays) * z[:, None]
    back = adjusted.world_from_cam[view]
    return view, xy, np.einsum("mij,mj->mi", back[:, :3, :3], rays) + back[:, :3, 3]
