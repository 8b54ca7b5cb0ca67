"""RealSense recordings (``.bag``) taken apart by Open3D's reader."""

from __future__ import annotations

from pathlib import Path

from gvtools.errors import ProjectError


def take_apart(bag: Path, folder: Path) -> float:
    """Write a recording's colour, and depth registered to it, as Redwood's layout has them.

    Args:
        bag: recorded by librealsense, with one colour and one depth stream of the same rate.
        folder: a new one, for ``color``, ``depth`` and ``intrinsic.json``.

    Returns:
        Metres per stored unit of depth.
    """
    import open3d as o3d

    if not hasattr(o3d.t.io, "RSBagReader"):
        raise ProjectError(
            f"{bag}: this machine's Open3D has no reader of RealSense recordings (its packages for "
            "x86-64 have one); convert it to folders color and depth there"
        )
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        try:
            reader = o3d.t.io.RGBDVideoReader.create(str(bag))
            readable = reader.is_opened()
            if readable:
                units = float(reader.metadata.depth_scale)
                reader.save_frames(str(folder))
        except RuntimeError:
            readable = False
    if not readable or not (folder / "color").is_dir() or not units > 0:
        raise ProjectError(
            f"{bag}: Open3D cannot read it; expected a recording by librealsense with a colour "
            "(RGB8) and a depth stream (Z16) of the same rate"
        )
    return 1 / units
