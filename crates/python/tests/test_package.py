"""The package against the program."""

import json
import os
import subprocess
import sys
import threading

import numpy as np
import pytest

import lidarshift

NOISE = """
[[effect]]
kind = "range_noise"
std_m = 0.02
[[effect]]
kind = "random_dropout"
share = 0.2
[[effect]]
kind = "range_quantisation"
step_m = 0.004
"""


def room(shift):
    """Walls around the sensor: 32 rows, 720 columns."""
    azimuth, elevation = np.meshgrid(np.radians(np.arange(720) / 2), np.radians(np.arange(-16, 16) / 2))
    distance = (10 + shift) / np.maximum(np.abs(np.cos(azimuth)), np.abs(np.sin(azimuth)))
    points = [distance * np.cos(azimuth), distance * np.sin(azimuth), distance * np.tan(elevation)]
    points.append(np.full_like(distance, 0.25))
    return np.stack(points, axis=-1).reshape(-1, 4).astype(np.float32)


@pytest.fixture
def folder(tmp_path):
    """Three frames in KITTI's layout with labels in the LiDAR frame."""
    for name in ("velodyne", "label_2", "ImageSets"):
        (tmp_path / name).mkdir()
    for i in range(3):
        room(i).tofile(tmp_path / f"velodyne/{i:06}.bin")
        (tmp_path / f"label_2/{i:06}.txt").write_text(
            "Car 0 0 -10 0 0 50 50 1.5 1.7 4.1 5 1.25 -0.5 0.3\nVan 0 0 -10 0 0 50 50 2 2 5 -5 1 0 3\n"
        )
    (tmp_path / "ImageSets/test.txt").write_text("000002\n")
    (tmp_path / "noise.toml").write_text(NOISE)
    return tmp_path


def test_a_data_set_iterates_over_its_frames(folder):
    dataset = lidarshift.Dataset(folder)
    assert (len(dataset), dataset.ids[0], dataset.classes, dataset.layout) == (3, "000000", ["Car", "Van"], "kitti")
    for i, frame in enumerate(dataset):
        assert frame.points.dtype == np.float32 and np.array_equal(frame.points, room(i))
        np.testing.assert_array_equal(frame.boxes[0], [5, 1.25, -0.5, 4.1, 1.7, 1.5, 0.3])
        assert (frame.classes, frame.tracks, frame.stamp_s) == (["Car", "Van"], [None, None], None)
    assert lidarshift.Dataset(folder, split="test").ids == ["000002"]
    assert np.array_equal(lidarshift.read_cloud(folder / "velodyne/000001.bin"), room(1))
    lidarshift.run("convert", folder, "--to", "mcap", "--out", folder / "made")
    frame = lidarshift.Dataset(folder / "made")[2]
    assert frame.stamp_s == pytest.approx(0.2) and np.array_equal(frame.points, room(2))


def test_a_recording_has_poses(tmp_path):
    (tmp_path / "velodyne").mkdir()
    for i in range(2):
        room(i).tofile(tmp_path / f"velodyne/{i:06}.bin")
    (tmp_path / "times.txt").write_text("7.0\n7.1\n")
    (tmp_path / "poses.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n0 -1 0 3 1 0 0 4 0 0 1 5\n")
    (tmp_path / "labels.csv").write_text("frame,track,class,cx,cy,cz,l,w,h,yaw\n1,a-7,Car,5,1,0,4,2,1.5,0.1\n")
    frame = lidarshift.Dataset(tmp_path).frame(1)
    assert frame.stamp_s == pytest.approx(0.1) and frame.tracks == ["a-7"]
    want = [[0, -1, 0, 3], [1, 0, 0, 4], [0, 0, 1, 5], [0, 0, 0, 1]]
    np.testing.assert_allclose(frame.world_from_lidar, want, atol=1e-12)


def test_another_library_reads_the_mcap_file(folder):
    pytest.importorskip("mcap_ros2")
    from mcap_ros2.reader import read_ros2_messages

    (folder / "drive/velodyne").mkdir(parents=True)
    for i in range(2):
        room(i).tofile(folder / f"drive/velodyne/{i:06}.bin")
    (folder / "drive/poses.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n0 -1 0 3 1 0 0 4 0 0 1 5\n")
    (folder / "drive/labels.csv").write_text(
        "frame,track,class,cx,cy,cz,l,w,h,yaw\n0,7,Car,5,1,-0.5,4,2,1.5,0.1\n1,7,Car,6,1,-0.5,4,2,1.5,0.1\n"
    )
    lidarshift.run("convert", folder / "drive", "--to", "mcap", "--out", folder / "made")
    found = {"/points": [], "/tf": [], "/boxes": []}
    for message in read_ros2_messages(str(folder / "made/data.mcap")):
        found[message.channel.topic].append(message.ros_msg)
    assert [len(messages) for messages in found.values()] == [2, 2, 2]
    for i, cloud in enumerate(found["/points"]):
        assert [f.name for f in cloud.fields] == ["x", "y", "z", "intensity"]
        assert (cloud.width, cloud.point_step, cloud.header.frame_id) == (len(room(i)), 16, "lidar")
        assert bytes(cloud.data) == room(i).tobytes()
    transform = found["/tf"][1].transforms[0]
    assert (transform.header.frame_id, transform.child_frame_id) == ("map", "lidar")
    moved, turned = transform.transform.translation, transform.transform.rotation
    np.testing.assert_allclose([moved.x, moved.y, moved.z], [3, 4, 5])
    np.testing.assert_allclose([turned.x, turned.y, turned.z, turned.w], [0, 0, 0.5**0.5, 0.5**0.5], atol=1e-9)
    clear, car = found["/boxes"][1].markers
    assert (clear.action, car.action, car.type, car.ns) == (3, 0, 1, "Car")
    np.testing.assert_allclose([car.pose.position.x, car.scale.x, car.scale.y, car.scale.z], [6, 4, 2, 1.5])


def test_effects_have_the_bits_of_the_command(folder):
    model = folder / "noise.toml"
    lidarshift.run("resim", folder, "--effects", model, "--seed", "3", "--out", folder / "made")
    dataset, made = lidarshift.Dataset(folder), lidarshift.Dataset(folder / "made")
    effects = lidarshift.Effects(model, like=dataset, seed=3)
    for i in range(3):
        assert effects(room(i), i).tobytes() == made.cloud(i).tobytes()
    # One cloud alone.
    alone = folder / "alone"
    (alone / "velodyne").mkdir(parents=True)
    room(1).tofile(alone / "velodyne/000000.bin")
    lidarshift.run("resim", alone, "--effects", model, "--seed", "5", "--out", folder / "alone-made")
    want = lidarshift.Dataset(folder / "alone-made").cloud(0)
    got = lidarshift.apply_effects(room(1), model, seed=5)
    assert got.tobytes() == want.tobytes() and len(got) < len(room(1))
    assert lidarshift.apply_effects(room(1), model, seed=5, frame=1).tobytes() != got.tobytes()
    # Other types and no intensity.
    assert lidarshift.apply_effects(room(1)[:, :3].astype(np.float64), model).shape[1] == 3


def test_threads_share_the_effects(folder):
    effects, made = lidarshift.Effects(folder / "noise.toml"), {}

    def work(i):
        made[i] = effects(room(i), i)

    threads = [threading.Thread(target=work, args=(i,)) for i in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert all(made[i].tobytes() == effects(room(i), i).tobytes() for i in range(4))


def test_the_script_of_an_export_calls_the_package(folder):
    lidarshift.run("export", folder / "noise.toml", "--to", "gazebo", "--out", folder / "gazebo")
    np.save(folder / "in.npy", room(0))
    command = [sys.executable, folder / "gazebo/post_process.py", folder / "in.npy", folder / "out.npy"]
    subprocess.run(command, check=True)
    want = lidarshift.apply_effects(room(0), folder / "gazebo/post_process.toml")
    assert np.load(folder / "out.npy").tobytes() == want.tobytes()


def test_average_precision_of_arrays_and_folders(folder):
    labels = [{"boxes": f.boxes, "classes": f.classes} for f in lidarshift.Dataset(folder)] * 20
    found = [{**f, "scores": [0.9, 0.8]} for f in labels]
    rows = lidarshift.kitti_ap(labels, found, classes=["Car"])["rows"]
    car = [r for r in rows if r["metric"] == "3d" and r["overlap"] == 0.7 and r["difficulty"] == "all"]
    assert car and car[0]["ap40"] == 100 and car[0]["n_gt"] == 60, rows
    (folder / "found").mkdir()
    for i in range(3):
        lines = (folder / f"label_2/{i:06}.txt").read_text().splitlines()
        (folder / f"found/{i:06}.txt").write_text("".join(f"{line} 0.9\n" for line in lines))
    report = lidarshift.kitti_ap(folder / "label_2", folder / "found", classes=["Car"])
    arguments = ["--labels", folder / "label_2", "--label-frame", "lidar", "--detections", folder / "found"]
    lidarshift.run("eval", "ap", *arguments, "--classes", "Car", "--json", folder / "ap.json")
    assert report == json.loads((folder / "ap.json").read_text())


def test_errors_have_file_and_hint(folder):
    (folder / "velodyne/000001.bin").write_bytes(b"123")
    with pytest.raises(lidarshift.LidarshiftError) as caught:
        lidarshift.Dataset(folder).frame(1)
    assert caught.value.file.endswith("000001.bin") and "truncated" in str(caught.value)
    (folder / "bad.toml").write_text('[[effect]]\nkind = "range_nose"\n')
    with pytest.raises(ValueError) as caught:
        lidarshift.apply_effects(room(0), folder / "bad.toml")
    assert caught.value.file.endswith("bad.toml") and caught.value.line == 2
    (folder / "ghosts.toml").write_text('[[effect]]\nkind = "ghosts"\nprobability = 0.1\n')
    with pytest.raises(lidarshift.LidarshiftError, match=r"effect\[0\]: ghosts"):
        lidarshift.apply_effects(room(0), folder / "ghosts.toml")
    for points in (np.zeros((0, 4)), np.zeros((5, 2)), np.full((5, 4), np.nan)):
        with pytest.raises(lidarshift.LidarshiftError):
            lidarshift.apply_effects(points, folder / "noise.toml")
    with pytest.raises(lidarshift.LidarshiftError, match="nowhere"):
        lidarshift.Dataset(folder / "nowhere")
    with pytest.raises(lidarshift.LidarshiftError, match="nowhere"):
        lidarshift.run("doctor", folder / "nowhere")
    with pytest.raises(lidarshift.LidarshiftError, match="unlike lengths"):
        lidarshift.kitti_ap([{"boxes": np.ones((1, 7)), "classes": []}], [{"boxes": [], "classes": [], "scores": []}])


def test_errors_of_commands_have_the_same_attributes(folder):
    def raised(function, *arguments, **options):
        with pytest.raises(lidarshift.LidarshiftError) as caught:
            function(*arguments, **options)
        return caught.value

    (folder / "bad.toml").write_text('[[effect]]\nkind = "range_noise"\nstd = 0.1\n')
    error = raised(lidarshift.run, "resim", folder, "--effects", folder / "bad.toml", "--out", folder / "made")
    assert (error.code, error.kind, error.line, error.hint) == (1, "invalid", 3, "did you mean `std_m`?")
    assert error.file.endswith("bad.toml") and "bad.toml:3: unknown field `std`" in str(error)
    # The same error without the program.
    native = raised(lidarshift.Effects, folder / "bad.toml")
    for name in ("file", "line", "hint", "code", "kind"):
        assert getattr(native, name) == getattr(error, name), name
    error = raised(lidarshift.diagnose, folder / "nowhere", folder, folder / "out")
    assert (error.code, error.kind, error.line) == (1, "missing", None) and error.file.endswith("nowhere")
    assert error.hint == "give the folder or the TOML of a data set"
    error = raised(lidarshift.diagnose, folder, folder, folder / "out", no_such_option=3)
    assert (error.code, error.kind, error.file) == (2, "usage", None) and "--no-such-option" in str(error)
    error = raised(lidarshift.twin, folder, folder / "twin", leave=0)
    assert error.code == 1 and error.hint == "give seconds above 0"
    error = raised(lidarshift.twin, folder / "nowhere", folder / "twin")
    assert (error.kind, error.file) == ("missing", str(folder / "nowhere"))
    (folder / "label_2/000001.txt").write_text("Car 1 2\n")
    error = raised(lidarshift.run, "resim", folder, "--effects", folder / "noise.toml", "--out", folder / "made")
    assert error.file.endswith("000001.txt") and error.line == 1, (error.file, str(error))
    # Without the check, stderr is what people read.
    done = lidarshift.run("doctor", folder / "nowhere", check=False)
    assert done.returncode == 1 and done.stderr.startswith("error: "), done.stderr


def test_a_diagnosis_of_few_frames(folder):
    lidarshift.run("resim", folder, "--effects", folder / "noise.toml", "--out", folder / "noisy")
    diagnosis = lidarshift.diagnose(folder / "noisy", folder, folder / "diagnosis")
    assert diagnosis["verdict"] == "too_few_frames", diagnosis["verdict"]
    with pytest.raises(lidarshift.LidarshiftError, match="nowhere"):
        lidarshift.diagnose(folder / "nowhere", folder, folder / "diagnosis")


def test_the_program_is_in_the_package():
    done = lidarshift.run("--version")
    assert done.stdout.split() == ["lidarshift", lidarshift.__version__]
    assert lidarshift.run("no-such-command", check=False).returncode == 2


# 100 for the number in the documentation; it takes minutes.
ONNX_CLOUDS = int(os.environ.get("LIDARSHIFT_ONNX_CLOUDS", "1"))

NETWORKS = {
    "pointpillars": """
vfe_filters = 8
[[network.anchors]]
class = "Car"
size_m = [3.9, 1.6, 1.56]
bottom_m = -1.78
matched = 0.6
unmatched = 0.45
""",
    "centerpoint": """
vfe_filters = [8, 8]
[network.head]
filters = 8
""",
}


@pytest.mark.parametrize("kind", NETWORKS)
@pytest.mark.parametrize("strides", ["[1, 2]", "[0.5, 1]"])
def test_onnx_graphs_give_the_same_numbers(folder, kind, strides):
    pytest.importorskip("onnxruntime")
    (folder / "tiny.toml").write_text(
        f"""
name = "tiny"
classes = ["Car"]
channels = 4
range_m = [-20.48, -20.48, -3.0, 20.48, 20.48, 3.0]
[network]
kind = "{kind}"
{NETWORKS[kind]}
[network.pillars]
size_m = [0.64, 0.64, 6.0]
max_points = 8
max_train = 1000
max_test = 1000
[network.backbone]
layers = [0, 1]
strides = [2, 2]
filters = [8, 16]
upsample_strides = {strides}
upsample_filters = [8, 8]
[optimization]
epochs = 2
batch_size = 2
"""
    )
    for split in ("train", "val"):
        (folder / f"ImageSets/{split}.txt").write_text("000000\n000001\n")
    (folder / "dataset.toml").write_text('classes = ["Car"]\n')
    lidarshift.run("train", "--dataset", folder, "--detector", folder / "tiny.toml", "--out", folder / "run")
    script, largest = [sys.executable, folder / "onnx/run_onnx.py"], []
    for i in range(ONNX_CLOUDS):
        # Points lost at random, noise, and another room in each cloud.
        random = np.random.default_rng(i)
        points = room(7 * random.random())
        points = points[random.random(len(points)) < 0.3 + 0.7 * random.random()]
        points[:, :3] += random.normal(0, 0.2, (len(points), 3))
        points[:, 3] = random.random(len(points))
        cloud = folder / f"check-{i}.bin"
        points.tofile(cloud)
        lidarshift.run("export", "--to", "onnx", folder / "run", "--check", cloud, "--out", folder / "onnx")
        done = subprocess.run([*script, "--check"], capture_output=True, text=True)
        assert done.returncode == 0, done.stdout + done.stderr
        largest.append(float(done.stdout.split()[-1]))
    assert max(largest) <= 1e-4
    print(f"{kind} {strides}: {len(largest)} clouds, largest difference {max(largest):.3g}")
    done = subprocess.run([*script, cloud], capture_output=True, text=True)
    assert "best score" in done.stdout, done.stderr
