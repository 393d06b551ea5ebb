//! Farthest point sampling (Qi et al. 2017, PointNet++, section 3.2). The indices equal those of OpenPCDet's CUDA
//! kernel.
//!
//! Each pick is the point whose distance to the nearest earlier pick is largest. The brute-force form visits every
//! point for every pick. Here points are sorted into small buckets with bounding boxes. A bucket is skipped if its
//! bounding box is farther from the new pick than each of its points is from its nearest pick. Bounds use the same f32
//! operations in the same order as distances. f32 rounding is monotone, so no bucket is skipped wrongly and the picks
//! equal those of the brute-force form, ties included.

/// Points in a bucket, at most.
const BUCKET: usize = 64;

/// Initial squared distance of each point to its nearest pick, m2, as in the reference. Larger distances are clamped to
/// it.
const FIRST_DISTANCE2_M2: f32 = 1e10;

/// Which of several points at the same distance is picked. Quantised clouds (KITTI: 1 mm) have such points.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum TieRule {
    /// As the reference's CUDA kernel. Thread k mod L handles point k, L = 2^floor(log2 N) but at most 1024. Within a
    /// thread the lower index wins, between threads the smaller bit-reversed thread number.
    ReferenceKernel,
    /// The lower index.
    LowestIndex,
}

impl TieRule {
    /// The tie-break key of each index: the smallest key is picked.
    fn ranks(self, points: usize) -> impl Fn(usize) -> u32 {
        let bits = match self {
            TieRule::ReferenceKernel => points.max(1).ilog2().min(10),
            TieRule::LowestIndex => 0,
        };
        let in_lane = points.div_ceil(1 << bits);
        move |index| {
            let lane = (index & ((1 << bits) - 1)) as u32;
            let reversed = if bits == 0 { 0 } else { lane.reverse_bits() >> (32 - bits) };
            reversed * in_lane as u32 + (index >> bits) as u32
        }
    }
}

/// Indices of `count` points: first point 0, then the farthest from all picked so far. If there are fewer points than
/// `count`, some are repeated.
///
/// Coordinates must be finite. Without points the result is empty.
///
/// # Shapes
/// `points`: `[N]`, m; result `[count]`.
pub fn farthest_point_sampling(points: &[[f32; 3]], count: usize, ties: TieRule) -> Vec<u32> {
    if points.is_empty() || count == 0 {
        return Vec::new();
    }
    let mut cloud = Buckets::new(points, ties);
    let mut picks = Vec::with_capacity(count);
    let mut pick = 0;
    picks.push(pick as u32);
    while picks.len() < count {
        cloud.update_distances(points[pick]);
        pick = cloud.farthest();
        picks.push(pick as u32);
    }
    picks
}

/// Points sorted into buckets, stored by coordinate. A bucket is ordered by rank, so that its first point wins ties.
struct Buckets {
    xyz: [Vec<f32>; 3],
    /// Distance to the nearest pick, squared, m2.
    distance2: Vec<f32>,
    index: Vec<u32>,
    rank: Vec<u32>,
    /// Bucket b has the points `starts[b]..starts[b + 1]`.
    starts: Vec<u32>,
    low: [Vec<f32>; 3],
    high: [Vec<f32>; 3],
    /// Largest distance in each bucket, and the position of its first point at that distance.
    largest: Vec<f32>,
    place: Vec<u32>,
    /// Buckets that the last pick may change.
    touched: Vec<u32>,
}

impl Buckets {
    fn new(points: &[[f32; 3]], ties: TieRule) -> Self {
        let rank_of = ties.ranks(points.len());
        let mut order: Vec<u32> = (0..points.len() as u32).collect();
        let mut starts = vec![0];
        split(points, &mut order, &mut starts);
        for bucket in starts.windows(2) {
            order[bucket[0] as usize..bucket[1] as usize].sort_unstable_by_key(|&i| rank_of(i as usize));
        }
        let bound = |start: f32, of: fn(f32, f32) -> f32| -> [Vec<f32>; 3] {
            [0, 1, 2].map(|axis| {
                let in_bucket = |w: &[u32]| {
                    let members = &order[w[0] as usize..w[1] as usize];
                    members.iter().fold(start, |bound, &i| of(bound, points[i as usize][axis]))
                };
                starts.windows(2).map(in_bucket).collect()
            })
        };
        let buckets = starts.len() - 1;
        Buckets {
            xyz: [0, 1, 2].map(|axis| order.iter().map(|&i| points[i as usize][axis]).collect()),
            distance2: vec![FIRST_DISTANCE2_M2; points.len()],
            rank: order.iter().map(|&i| rank_of(i as usize)).collect(),
            low: bound(f32::INFINITY, f32::min),
            high: bound(f32::NEG_INFINITY, f32::max),
            largest: vec![FIRST_DISTANCE2_M2; buckets],
            place: starts[..buckets].to_vec(),
            touched: Vec::with_capacity(buckets),
            index: order,
            starts,
        }
    }

    /// Updates the distances after a pick.
    fn update_distances(&mut self, pick: [f32; 3]) {
        self.touched.clear();
        self.touched.resize(self.largest.len(), 0);
        let mut count = 0;
        for b in 0..self.largest.len() {
            // The same f32 operations as for `distance2` below. They are monotone, so no point of the bucket is nearer
            // than this.
            let apart = [0, 1, 2].map(|axis| {
                let (under, over) = (self.low[axis][b] - pick[axis], pick[axis] - self.high[axis][b]);
                let outside = if under > over { under } else { over };
                if outside > 0.0 { outside } else { 0.0 }
            });
            let bound = apart[0] * apart[0] + apart[1] * apart[1] + apart[2] * apart[2];
            self.touched[count] = b as u32;
            count += usize::from(bound < self.largest[b]);
        }
        for t in 0..count {
            let b = self.touched[t] as usize;
            let members = self.starts[b] as usize..self.starts[b + 1] as usize;
            let distance2 = &mut self.distance2[members.clone()];
            let [x, y, z] = &self.xyz;
            minimum_with(distance2, [&x[members.clone()], &y[members.clone()], &z[members.clone()]], pick);
            let largest = largest(distance2);
            let first = distance2.iter().position(|&d| d == largest).unwrap_or(0);
            self.largest[b] = largest;
            self.place[b] = (members.start + first) as u32;
        }
    }

    /// The point farthest from all picks.
    fn farthest(&self) -> usize {
        let largest = largest(&self.largest);
        let mut best = (u32::MAX, 0);
        for (b, _) in self.largest.iter().enumerate().filter(|(_, d)| **d == largest) {
            let place = self.place[b] as usize;
            best = best.min((self.rank[place], self.index[place]));
        }
        best.1 as usize
    }
}

/// Splits `order` at the median of the widest axis until each bucket is small enough, and appends the ends of the
/// buckets.
fn split(points: &[[f32; 3]], order: &mut [u32], ends: &mut Vec<u32>) {
    if order.len() <= BUCKET {
        ends.push(ends[ends.len() - 1] + order.len() as u32);
        return;
    }
    let width = |axis: usize| {
        let values = order.iter().map(|&i| points[i as usize][axis]);
        let (low, high) = values.fold((f32::INFINITY, f32::NEG_INFINITY), |(l, h), v| (l.min(v), h.max(v)));
        high - low
    };
    let widths = [width(0), width(1), width(2)];
    let axis = (0..3).fold(0, |widest, axis| if widths[axis] > widths[widest] { axis } else { widest });
    // The median is rounded up to a multiple of the bucket size, so that all buckets but the last are full.
    let middle = (order.len() / 2).next_multiple_of(BUCKET).min(order.len() - 1);
    order.select_nth_unstable_by(middle, |&a, &b| points[a as usize][axis].total_cmp(&points[b as usize][axis]));
    let (left, right) = order.split_at_mut(middle);
    split(points, left, ends);
    split(points, right, ends);
}

/// The minimum of each squared distance and the squared distance to `pick`.
fn minimum_with(distance2: &mut [f32], xyz: [&[f32]; 3], pick: [f32; 3]) {
    let n = distance2.len();
    let [x, y, z] = xyz.map(|values| &values[..n]);
    for i in 0..n {
        let apart = [x[i] - pick[0], y[i] - pick[1], z[i] - pick[2]];
        let d = apart[0] * apart[0] + apart[1] * apart[1] + apart[2] * apart[2];
        distance2[i] = if d < distance2[i] { d } else { distance2[i] };
    }
}

/// The maximum of non-negative values; 0 for an empty slice.
fn largest(values: &[f32]) -> f32 {
    let (chunks, rest) = values.as_chunks::<16>();
    let mut most = [0.0f32; 16];
    for chunk in chunks {
        for (most, &v) in most.iter_mut().zip(chunk) {
            *most = if v > *most { v } else { *most };
        }
    }
    most.iter().chain(rest).fold(0.0, |most, &v| if v > most { v } else { most })
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// The CUDA kernel thread by thread: each thread keeps its first farthest point, then a tree reduction over the
    /// threads.
    fn by_lanes(points: &[[f32; 3]], count: usize) -> Vec<u32> {
        let lanes = (1usize << points.len().ilog2()).min(1024);
        let mut distance2 = vec![FIRST_DISTANCE2_M2; points.len()];
        let mut picks = vec![0u32];
        while picks.len() < count {
            let from = points[picks[picks.len() - 1] as usize];
            let mut best = vec![(-1.0f32, 0usize); lanes];
            for (k, p) in points.iter().enumerate() {
                let apart = [0, 1, 2].map(|axis| p[axis] - from[axis]);
                let d = apart[0] * apart[0] + apart[1] * apart[1] + apart[2] * apart[2];
                distance2[k] = d.min(distance2[k]);
                if distance2[k] > best[k % lanes].0 {
                    best[k % lanes] = (distance2[k], k);
                }
            }
            let mut half = lanes / 2;
            while half > 0 {
                for lane in 0..half {
                    if best[lane + half].0 > best[lane].0 {
                        best[lane] = best[lane + half];
                    }
                }
                half /= 2;
            }
            picks.push(best[0].1 as u32);
        }
        picks
    }

    fn by_index(points: &[[f32; 3]], count: usize) -> Vec<u32> {
        let mut distance2 = vec![FIRST_DISTANCE2_M2; points.len()];
        let mut picks = vec![0u32];
        while picks.len() < count {
            let from = points[picks[picks.len() - 1] as usize];
            let mut best = 0;
            for (k, p) in points.iter().enumerate() {
                let apart = [0, 1, 2].map(|axis| p[axis] - from[axis]);
                distance2[k] = distance2[k].min(apart[0] * apart[0] + apart[1] * apart[1] + apart[2] * apart[2]);
                if distance2[k] > distance2[best] {
                    best = k;
                }
            }
            picks.push(best as u32);
        }
        picks
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(1000))]
        #[test]
        fn equals_brute_force(
            points in prop::collection::vec(prop::array::uniform3(-40.0f32..40.0), 1..300),
            raster in prop_oneof![Just(0.0f32), Just(0.001), Just(0.5), Just(10.0)],
            share in 0.0f64..1.2,
        ) {
            // Quantised coordinates give ties and equal points.
            let on_raster = |v: f32| if raster > 0.0 { (v / raster).round() * raster } else { v };
            let points: Vec<[f32; 3]> = points.iter().map(|p| p.map(on_raster)).collect();
            let count = ((points.len() as f64 * share) as usize).clamp(1, 60);
            prop_assert_eq!(farthest_point_sampling(&points, count, TieRule::ReferenceKernel), by_lanes(&points, count));
            prop_assert_eq!(farthest_point_sampling(&points, count, TieRule::LowestIndex), by_index(&points, count));
        }
    }

    #[test]
    fn more_picks_than_points_and_equal_points() {
        let picks = farthest_point_sampling(&[[1.0, 0.0, 0.0], [2.0, 0.0, 0.0]], 4, TieRule::ReferenceKernel);
        assert_eq!(picks, [0, 1, 0, 0]);
        assert_eq!(farthest_point_sampling(&[[3.0; 3]; 100], 3, TieRule::ReferenceKernel), [0, 0, 0]);
        assert!(farthest_point_sampling(&[], 3, TieRule::ReferenceKernel).is_empty());
        assert!(farthest_point_sampling(&[[0.0; 3]], 0, TieRule::ReferenceKernel).is_empty());
    }

    #[test]
    fn far_away_points_are_as_far_as_the_first_distance() {
        let points: Vec<[f32; 3]> = (0..200).map(|i| [1e6 * (i % 7) as f32, 1e5 * i as f32, 0.0]).collect();
        assert_eq!(farthest_point_sampling(&points, 50, TieRule::ReferenceKernel), by_lanes(&points, 50));
    }
}
