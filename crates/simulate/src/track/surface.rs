//! Ground and walls as strips along the centre line.

use super::{Station, Track};
use crate::mesh::{Mesh, grid};
use data::stream;
use rand::RngExt;
use sensor::material::MaterialTable;
use sensor::object::Group;

/// Width of the apron, m.
const APRON_M: f64 = 8.0;
/// Cross slope of the apron, rad.
const APRON_BANK_RAD: f64 = 0.05;
/// Width of the infield mesh beyond the apron, m.
const INFIELD_M: f64 = 90.0;
/// Drop of the infield below the inner edge of the apron, m.
const INFIELD_DROP_M: f64 = 0.25;
/// Distance from the outer edge of the surface to the face of the wall, m.
pub(super) const WALL_GAP_M: f64 = 0.4;
/// Thickness of the wall, m.
pub(super) const WALL_M: f64 = 0.5;
/// Height of the wall above the outer edge, m.
pub(super) const WALL_HEIGHT_M: f64 = 1.1;
/// Width of the outside ground mesh, m.
const OUTSIDE_M: f64 = 110.0;
/// Width over which the bank outside the wall falls to the level ground, m.
const EMBANKMENT_M: f64 = 14.0;
/// Height of the outside ground, m.
pub(super) const OUTSIDE_LEVEL_M: f64 = -0.8;
/// Row spacing of the surface triangles, m.
const ROW_M: f64 = 2.5;

/// Height at `left_m` to the left of the centre, m.
pub(super) fn height_m(station: &Station, left_m: f64) -> f64 {
    let z = station.position[2];
    let inner = z - station.width_left_m * station.bank_rad.tan();
    let apron = inner - APRON_M * APRON_BANK_RAD;
    let (beyond, outside) = (left_m - station.width_left_m, -left_m - station.width_right_m);
    if beyond > APRON_M {
        apron - INFIELD_DROP_M * ((beyond - APRON_M) / 4.0).min(1.0)
    } else if beyond > 0.0 {
        inner - beyond * APRON_BANK_RAD
    } else if outside > WALL_GAP_M + WALL_M {
        let edge = z + station.width_right_m * station.bank_rad.tan();
        let down = ((outside - WALL_GAP_M - WALL_M) / EMBANKMENT_M).min(1.0);
        edge + down * (OUTSIDE_LEVEL_M - edge)
    } else {
        z - left_m * station.bank_rad.tan()
    }
}

/// Meshes rows of points across the track: `across` gives (lateral offset, height) of each column.
pub(super) fn strip(
    track: &Track,
    row_m: f64,
    across: impl Fn(&Station, usize) -> Vec<(f64, f64)>,
) -> Vec<Vec<[f64; 3]>> {
    let lap = track.line.length_m();
    let rows = (lap / row_m).round() as usize;
    let row = |i: usize| across_at(track, lap * i as f64 / rows as f64, |station| across(station, i % rows));
    (0..=rows).map(row).collect()
}

/// Points across the track at one position.
pub(super) fn across_at(track: &Track, way_m: f64, across: impl Fn(&Station) -> Vec<(f64, f64)>) -> Vec<[f64; 3]> {
    let station = track.line.at(way_m);
    let (s, c) = station.heading_rad.sin_cos();
    let [x, y, _] = station.position;
    across(&station).into_iter().map(|(left, z)| [x - s * left, y + c * left, z]).collect()
}

/// `n + 1` equidistant values from `low` to `high`.
fn evenly(low: f64, high: f64, n: usize) -> impl Iterator<Item = f64> {
    (0..=n).map(move |i| low + (high - low) * i as f64 / n as f64)
}

/// One of the four strips of ground. Roughness is some millimetres on the track and some centimetres beside it.
pub(super) fn ground(track: &Track, group: Group) -> Mesh {
    let (material, row_m, columns, rough_m) = match group {
        Group::Surface => ("asphalt", ROW_M, 8, 0.002),
        Group::Apron => ("apron", ROW_M, 3, 0.003),
        Group::Infield => ("grass", 2.0 * ROW_M, 14, 0.05),
        _ => ("sand", 2.0 * ROW_M, 14, 0.08),
    };
    let lefts = |station: &Station| -> Vec<f64> {
        let (inner, outer) = (station.width_left_m, -station.width_right_m);
        match group {
            Group::Surface => evenly(outer - WALL_GAP_M, inner, columns).collect(),
            Group::Apron => evenly(inner, inner + APRON_M, columns).collect(),
            Group::Infield => evenly(0.0, 1.0, columns).map(|t| inner + APRON_M + INFIELD_M * t * t).collect(),
            _ => evenly(0.0, 1.0, columns).map(|t| outer - WALL_GAP_M - WALL_M - 0.01 - OUTSIDE_M * t * t).collect(),
        }
    };
    let lap_rows = (track.line.length_m() / row_m).round() as usize;
    let mut random = stream(track.seed, &format!("track/{group:?}"), 0, 0);
    let bumps: Vec<f64> = (0..lap_rows * (columns + 1)).map(|_| random.random_range(-rough_m..rough_m)).collect();
    let points = strip(track, row_m, |station, row| {
        let height = |(column, left): (usize, f64)| {
            let border = column == 0 || column == columns;
            let bump = if border { 0.0 } else { bumps[row * (columns + 1) + column] };
            (left, height_m(station, left) + bump)
        };
        lefts(station).into_iter().enumerate().map(height).collect()
    });
    let mut mesh = grid(&points, MaterialTable::built_in(material));
    if group == Group::Infield {
        // In the deep infield, a level plane just below the strips.
        let level = points.iter().filter_map(|row| row.last()).map(|v| v[2]).fold(f64::INFINITY, f64::min) - 0.3;
        mesh.append(&plain(&points, level));
    }
    mesh
}

/// A grid of level squares over the bounds of the strip's inner edge.
fn plain(points: &[Vec<[f64; 3]>], level_m: f64) -> Mesh {
    let inner: Vec<[f64; 3]> = points.iter().filter_map(|row| row.last().copied()).collect();
    let bound = |k: usize| inner.iter().map(|v| v[k]).fold([f64::MAX, f64::MIN], |[l, h], v| [l.min(v), h.max(v)]);
    let ([x0, x1], [y0, y1]) = (bound(0), bound(1));
    let rows: Vec<Vec<[f64; 3]>> =
        evenly(x0, x1, 24).map(|x| evenly(y0, y1, 12).map(|y| [x, y, level_m]).collect()).collect();
    grid(&rows, MaterialTable::built_in("grass"))
}

/// The wall along the outer edge, all around.
pub(super) fn outer_wall(track: &Track) -> Mesh {
    let points = strip(track, 2.0 * ROW_M, |station, _| {
        let face = -station.width_right_m - WALL_GAP_M;
        let base = height_m(station, face);
        let top = height_m(station, -station.width_right_m) + WALL_HEIGHT_M;
        vec![(face, base - 0.3), (face, top), (face - WALL_M, top), (face - WALL_M, base.min(OUTSIDE_LEVEL_M) - 0.3)]
    });
    grid(&points, MaterialTable::built_in("wall"))
}

/// The wall between the apron and the pit lane, along the front stretch.
pub(super) fn pit_wall(track: &Track) -> Mesh {
    let rows: Vec<Vec<[f64; 3]>> = (-60..=60)
        .map(|i| {
            across_at(track, f64::from(i) * 5.0, |station| {
                let face = station.width_left_m + APRON_M + 1.0;
                let base = height_m(station, face);
                vec![(face, base - 0.3), (face, base + 0.9), (face + 0.4, base + 0.9), (face + 0.4, base - 0.3)]
            })
        })
        .collect();
    grid(&rows, MaterialTable::built_in("concrete"))
}
