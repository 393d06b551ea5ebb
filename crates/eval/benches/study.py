"""Times of other implementations on the inputs of the benchmark `study`.

    cargo bench -p lidarshift-eval --bench study -- FOLDER
    python study.py FOLDER        # with numpy, scipy and scikit-learn; openTSNE, open3d and POT where they are installed

Both on the same threads, as `taskset -c 0,1` gives them.
"""

import statistics
import sys
import time

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

folder = sys.argv[1]


def load(name, columns):
    return np.fromfile(f"{folder}/{name}", dtype=np.float32).reshape(-1, columns)


def timed(what, repetitions, work):
    seconds = []
    for _ in range(repetitions):
        begin = time.perf_counter()
        result = work()
        seconds.append(time.perf_counter() - begin)
    print(f"{what}: {statistics.median(seconds):.4f} s, median of {repetitions}", flush=True)
    return result


a, b, vectors = load("a.f32", 3), load("b.f32", 3), load("vectors.f32", 128)


def chamfer_scipy():
    forth = cKDTree(b, leafsize=16, balanced_tree=False, compact_nodes=False).query(a, workers=2)[0]
    back = cKDTree(a, leafsize=16, balanced_tree=False, compact_nodes=False).query(b, workers=2)[0]
    return (forth**2).sum() + (back**2).sum()


print(f"  sum {timed('Chamfer, SciPy', 15, chamfer_scipy):.4f} m2")
try:
    import open3d

    clouds = [open3d.geometry.PointCloud(open3d.utility.Vector3dVector(c.astype(np.float64))) for c in (a, b)]

    def chamfer_open3d():
        distances = [clouds[i].compute_point_cloud_distance(clouds[1 - i]) for i in (0, 1)]
        return sum((np.asarray(d) ** 2).sum() for d in distances)

    print(f"  sum {timed('Chamfer, Open3D', 15, chamfer_open3d):.4f} m2")
except ImportError:
    print("Open3D is not installed")


def emd_scipy():
    cost = cdist(a[:1024].astype(np.float64), b[:1024].astype(np.float64))
    rows, columns = linear_sum_assignment(cost)
    return cost[rows, columns].mean()


print(f"  {timed('EMD, SciPy', 7, emd_scipy):.6f} m")
try:
    import ot

    def emd_pot():
        cost = cdist(a[:1024].astype(np.float64), b[:1024].astype(np.float64))
        return ot.emd2([], [], cost)

    print(f"  {timed('EMD, POT', 7, emd_pot):.6f} m")
except ImportError:
    print("POT is not installed")

from sklearn.manifold import TSNE

fit = timed(
    "t-SNE, scikit-learn",
    1,
    lambda: TSNE(perplexity=30, max_iter=1000, init="pca", n_jobs=2, random_state=0).fit(vectors),
)
print(f"  Kullback-Leibler divergence {fit.kl_divergence_:.4f}")
try:
    from openTSNE import TSNE as OpenTSNE

    fit = timed("t-SNE, openTSNE", 1, lambda: OpenTSNE(perplexity=30, n_jobs=2, random_state=0).fit(vectors))
    print(f"  Kullback-Leibler divergence {fit.kl_divergence:.4f}")
    # Divergences of both implementations' pictures by one and the same formula.
    from openTSNE import affinity

    near = affinity.PerplexityBasedNN(vectors, perplexity=30, n_jobs=2, random_state=0).P.tocoo()
    for name in ("barnes_hut", "interpolated"):
        y = load(f"{name}.f32", 2).astype(np.float64)
        z = sum((1 / (1 + cdist(part, y, "sqeuclidean"))).sum() - len(part) for part in np.array_split(y, 20))
        q = 1 / (1 + ((y[near.row] - y[near.col]) ** 2).sum(axis=1)) / z
        divergence = (near.data * np.log(near.data / q)).sum()
        print(f"  Kullback-Leibler divergence of {name} over openTSNE's affinities {divergence:.4f}")
except ImportError:
    print("openTSNE is not installed")
