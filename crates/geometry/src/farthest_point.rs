//! Farthest point sampling (Qi et al. 2017, PointNet++, section 3.2), index for index as OpenPCDet's kernel does it.
//!
//! Each pick is the point whose distance to the nearest earlier pick is largest. The plain form looks at every point for every pick.
//! Here points lie in small buckets with bounds: a bucket that is farther from the new pick than all its points are from their nearest pick
//! cannot change and is passed over. Bounds are computed by the same f32 operations in the same order as distances; rounding keeps order,
//! so that nothing is passed over by mistake and the picks are those of the plain form, ties included.

/// Points in a bucket, at most.
const BUCKET: usize = 64;

/// Nearest pick of a point before the first pick, squared, m2: the reference's start value. Larger distances count as this one.
const FIRST_DISTANCE2_M2: f32 = 1e10;

/// Which of several points at the same distance is picked. Clouds on a grid (KITTI's is one of 1 mm) do have such points.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum TieRule {
    /// As the reference's CUDA kernel: point k is seen by lane k mod L, L = 2^floor(log2 N) but at most 1024; inside a lane the lower index
    /// wins, between lanes the one with the smaller bit-reversed number.
    ReferenceKernel,
    /// The lower index.
    LowestIndex,
}

impl TieRule {
    /// Key of each index; of equally far points the one with the smallest key is picked.
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

/// Indices of `count` points: first point 0, then the farthest from all picked so far. With fewer points than `count` some come twice.
///
/// Coordinates must be finite. No point at all gives no index.
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
        cloud.bring_nearer(points[pick]);
        pick = cloud.farthest();
        picks.push(pick as u32);
    }
    picks
}

/// Points sorted into buckets, coordinate by coordinate. Inside a bucket they are ordered by rank, so that the first of equal ones wins.
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
    /// Largest distance in each bucket, and the place of its first point at that distance.
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

    /// Takes a pick into the distances.
    fn bring_nearer(&mut self, pick: [f32; 3]) {
        self.touched.clear();
        self.touched.resize(self.largest.len(), 0);
        let mut count = 0;
        for b in 0..self.largest.len() {
            // In f32 as `distance2` below: subtraction, square and sum are monotone, so no point of the bucket comes out nearer.
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
            nearer(distance2, [&x[members.clone()], &y[members.clone()], &z[members.clone()]], pick);
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

/// Cuts `order` at the middle of the widest axis until a bucket is small enough; appends the ends of the buckets.
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
    // Full buckets but for the last: the middle is rounded to a multiple of the bucket.
    let middle = (order.len() / 2).next_multiple_of(BUCKET).min(order.len() - 1);
    order.select_nth_unstable_by(middle, |&a, &b| points[a as usize][axis].total_cmp(&points[b as usize][axis]));
    let (left, right) = order.split_at_mut(middle);
    split(points, left, ends);
    split(points, right, ends);
}

/// Each distance, or the one to `pick` where that is smaller.
fn nearer(distance2: &mut [f32], xyz: [&[f32]; 3], pick: [f32; 3]) {
    let n = distance2.len();
    let [x, y, z] = xyz.map(|values| &values[..n]);
    for i in 0..n {
        let apart = [x[i] - pick[0], y[i] - pick[1], z[i] - pick[2]];
        let d = apart[0] * apart[0] + apart[1] * apart[1] + apart[2] * apart[2];
        distance2[i] = if d < distance2[i] { d } else { distance2[i] };
    }
}

/// The largest of values that are not negative; 0 of none.
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

    /// The kernel, thread by thread: each lane keeps its first farthest point, then halves of the lanes are compared.
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
        fn equals_the_plain_form(
            points in prop::collection::vec(prop::array::uniform3(-40.0f32..40.0), 1..300),
            raster in prop_oneof![Just(0.0f32), Just(0.001), Just(0.5), Just(10.0)],
            share in 0.0f64..1.2,
        ) {
            // On a raster many points are equally far, or equal.
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
