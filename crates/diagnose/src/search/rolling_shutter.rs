//! Motion distortion: static objects are displaced along the scan as the ego vehicle drives, by metres at speed.
//! Searched first, since it shears whole scenes, and undone for the other channels.
//!
//! For each duration of a scan, measured returns are moved back to their place in the middle of the scan. The
//! duration is that with the most returns in occupied cells of the simulation, in bird's-eye view. Rays need not be
//! paired, so that displacements of metres are found.

mod grid;
mod own_slides;
mod slide;
mod top_view;

pub use self::slide::{Extent, Slide};

use self::grid::{Grid, peak};
use self::own_slides::OwnSlides;
use self::slide::{Motion, alike, driven, relative_error};
use self::top_view::TopView;
use super::returns::surfaces_stand_elsewhere;
use super::{ChannelResult, Context, Found, REPETITIONS, Z_STAR};
use crate::catalogue::{Cause, Channel, Covariate};
use crate::channels::mean::origins;
use crate::channels::motion::{CELL_M, OwnMotion};
use crate::curve::{Curve, CurvePoint};
use crate::diagnosis::{Considered, Status};
use crate::inference::choice::{significant, total_and_z};
use crate::inference::linear::cross_validated;
use crate::inference::median;
use crate::inference::roles::Role;
use nalgebra::Vector2;
use rayon::prelude::*;
use statistics::{blocks_of, draw_blocks};

/// Steps of the grid to either side of zero.
const STEPS: i32 = 28;

/// Step of the duration of a scan, s.
const STEP_S: f64 = 0.005;

/// Step of the displacement over a scan where the ego speed is not known, m.
const STEP_M: f64 = 0.25;

/// Steps of the displacement of a frame to either side of zero, as far as [`STEPS`] of [`STEP_M`].
const FINE_STEPS: i32 = 70;

/// Step of the displacement of a frame, m.
const FINE_STEP_M: f64 = 0.1;

/// Error of a displacement over a scan by the size of cells, m.
const OF_CELLS_M: f64 = 0.1 * CELL_M;

/// Smallest displacement that is searched for, m: smaller ones are found by surfaces.
const LEAST_M: f64 = 0.3;

/// Share of the returns on the simulation by which a maximum may be lower than the highest one and still be as high.
const LEAST_SHARE: f64 = 0.015;

/// Result of the search.
pub enum Search {
    /// No displacement along the scan.
    NotFound(ChannelResult),
    /// A significant displacement.
    Found(ChannelResult, Slide),
    /// A displacement that is not significant from above. Whether it is one is decided after the whole scene was
    /// moved back by it.
    Undecided {
        /// Result if it is one.
        found: ChannelResult,
        /// The displacement.
        slide: Slide,
        /// Result if it is none.
        not_found: ChannelResult,
    },
}

/// The search.
pub fn search(context: &Context) -> Search {
    let [select, estimate, hold_out] = [Role::Select, Role::Estimate, Role::HoldOut].map(|r| context.of(r));
    let mut result = ChannelResult::new(Channel::Slide, hold_out.len());
    let views = top_views(context);
    let mut models = models(context, &views);
    let mut grids = models.iter().map(|model| model.grid(&select, &context.blocks(&select))).collect::<Vec<_>>();
    let total = |k: usize| total_and_z(&grids[k].gains).0;
    let best = (0..models.len()).max_by(|&a, &b| total(a).total_cmp(&total(b)));
    let Some(best) = best else { return Search::NotFound(result) };
    let (_, z) = total_and_z(&grids[best].gains);
    let significant = significant(&grids[best].gains, Z_STAR);
    let considered = |outcome: &str| Considered {
        cause: Cause::RollingShutter.into(),
        channel: Channel::Slide,
        nats_per_ray: 0.0,
        z,
        outcome: outcome.into(),
    };
    let far_enough = |k: usize, at: f64| at.abs() * models[k].fastest > LEAST_M;
    let decided = significant && far_enough(best, grids[best].best());
    let outcome =
        if significant { "too small to be seen from above" } else { "no more returns come to lie on the simulation" };
    let not_found = ChannelResult { considered: vec![considered(outcome)], ..result.clone() };
    let chosen = if decided {
        Some((best, grids[best].best()))
    } else {
        // Along walls and fences a displaced scene may look like another one from above. Returns that lie off the
        // simulated surfaces say that there is something.
        let peaks = (0..models.len()).filter_map(|k| Some((k, grids[k].highest(|at| far_enough(k, at))?)));
        let highest = peaks.max_by(|a, b| a.1.1.total_cmp(&b.1.1));
        let as_high = highest.filter(|(_, (_, share))| *share > 1.0 - LEAST_SHARE);
        as_high.filter(|_| surfaces_stand_elsewhere(context)).map(|(k, (at, _))| (k, at))
    };
    let Some((k, at)) = chosen else { return Search::NotFound(not_found) };
    let (grid, mut model) = (grids.swap_remove(k), models.swap_remove(k));
    result.considered.push(considered("chosen"));
    let mut fitted = Fitted::new(context, &model, at, &estimate);
    let held = model.held_out_gains(&grid, &fitted, &select, &hold_out);
    result.distance.iter_mut().zip(&held).for_each(|(d, g)| *d = [g.max(0.0), *g, g.max(0.0)]);
    let of_frames = (!model.speed_known).then(|| fitted.own_slides(context, &model, model.worth(&grid, &select)));
    let scan_s = match of_frames {
        Some(slides) => {
            model.motions.iter_mut().zip(slides).for_each(|(motion, slide)| motion.own = OwnMotion::ahead(slide));
            1.0
        }
        None => fitted.extent.scan_s,
    };
    result.found.push(fitted.found(&model, &estimate, held));
    let slide = Slide::new(context, scan_s, model.motions, Some(fitted.extent));
    if decided { Search::Found(result, slide) } else { Search::Undecided { found: result, slide, not_found } }
}

/// Gains of the `test` frames by the displacement along the scan that fits the `train` frames best, nats.
pub fn by_table(context: &Context, train: &[usize], test: &[usize]) -> Vec<f64> {
    let views = top_views(context);
    let models = models(context, &views);
    let fits = models.iter().map(|model| (model, model.grid(train, &context.blocks(train))));
    let sum = |grid: &Grid| grid.gains.iter().sum::<f64>();
    let Some((model, grid)) = fits.max_by(|a, b| sum(&a.1).total_cmp(&sum(&b.1))) else {
        return vec![0.0; test.len()];
    };
    model.gains_of(&grid, grid.best(), train, test)
}

/// The duration of a scan, fitted on the estimating frames.
struct Fitted {
    /// Durations of a finer grid about the best of the selecting frames, and the counts of every frame.
    fine: Vec<f64>,
    counts: Vec<Vec<f64>>,
    extent: Extent,
    /// Share of bootstrap repetitions with the same sign.
    confidence: f64,
}

impl Fitted {
    fn new(context: &Context, model: &Model, best: f64, estimate: &[usize]) -> Self {
        let fine: Vec<f64> = (-20..=20).map(|k| best + 0.2 * model.step * f64::from(k)).collect();
        let counts = model.counts(estimate, &fine);
        let members = blocks_of(&context.blocks(estimate));
        let mut rng = data::stream(0, "diagnose shutter", 0, 0);
        let all: Vec<usize> = (0..estimate.len()).collect();
        let scan_s = peak(&fine, &counts, &all);
        let draws: Vec<f64> =
            (0..REPETITIONS).map(|_| peak(&fine, &counts, &draw_blocks(&members, &mut rng))).collect();
        let spread = (draws.iter().map(|d| (d - scan_s).powi(2)).sum::<f64>() / draws.len() as f64).sqrt();
        // The size of a cell, and errors of the ego speed and of the form.
        let error = spread.hypot(relative_error() * scan_s).hypot(OF_CELLS_M / model.fastest.max(1.0));
        let confidence = draws.iter().filter(|d| d.signum() == scan_s.signum()).count() as f64 / draws.len() as f64;
        let middle_m_s = median(model.motions.iter().map(|m| m.own.speed_m_s()).collect());
        let speed_known = model.speed_known;
        let extent = Extent { scan_s, error, uneven_s: None, middle_m_s, speed_known, from_frame_to_frame: None };
        Fitted { fine, counts, extent, confidence }
    }

    /// The displacement of each frame, m, where speeds are not known: they differ, and with them the displacements. A
    /// point on the simulation is worth `worth` nats. The estimate becomes the mean over the estimating frames.
    fn own_slides(&mut self, context: &Context, model: &Model, worth: f64) -> Vec<f64> {
        let at: Vec<f64> = (-FINE_STEPS..=FINE_STEPS).map(|k| FINE_STEP_M * f64::from(k)).collect();
        let all: Vec<usize> = (0..context.frames.len()).collect();
        let mut frames = model.counts(&all, &at);
        frames.iter_mut().flatten().for_each(|count| *count *= worth);
        let estimate = context.of(Role::Estimate);
        let estimating: Vec<&[f64]> = estimate.iter().map(|&f| &frames[f][..]).collect();
        let own = OwnSlides::fit(&at, &estimating, &blocks_of(&context.blocks(&estimate)), self.extent.scan_s);
        (self.extent.scan_s, self.extent.error) =
            (own.mean, own.error.hypot(relative_error() * own.mean).hypot(OF_CELLS_M));
        self.extent.from_frame_to_frame = Some(own.spread);
        frames.iter().map(|frame| own.of_frame(&at, frame)[0]).collect()
    }

    /// The finding.
    fn found(&self, model: &Model, estimate: &[usize], held_out_gains: Vec<f64>) -> Found {
        Found {
            effects: Vec::new(),
            status: Status::Named,
            causes: vec![Cause::RollingShutter],
            parameters: self.extent.parameters(),
            confidence: self.confidence,
            channel: Channel::Slide,
            covariate: Covariate::ScanPhase,
            held_out_gains,
            says: self.extent.says(),
            separate_by: None,
            curve: self.curve(model, estimate),
        }
    }

    /// Share of the static returns that lie on the simulation, by the duration of a scan.
    fn curve(&self, model: &Model, estimate: &[usize]) -> Curve {
        let points = model.points(estimate);
        let share = |on: f64| on / points.max(1.0);
        let on = |at: f64| estimate.iter().map(|&f| model.on(f, at)).sum();
        let [before, after] = [0.0, self.extent.scan_s].map(|at| share(on(at)));
        let points = self.fine.iter().enumerate().map(|(k, s)| {
            let measured = share(self.counts.iter().map(|counts| counts[k]).sum());
            CurvePoint { sensor: 0, x: -s, measured, before, after, error: 0.0 }
        });
        Curve {
            x: if model.speed_known { "time that a scan takes, s" } else { "slide over a scan, m" }.into(),
            y: "share of standing returns on the simulation".into(),
            by_sensor: false,
            points: points.collect(),
        }
    }
}

/// All frames in bird's-eye view.
fn top_views<'a>(context: &Context<'a>) -> Vec<TopView<'a>> {
    let origins = origins(context.rig);
    context.frames.par_iter().map(|frame| TopView::new(frame, context.rig, &origins)).collect()
}

/// The models of a context.
fn models<'a>(context: &Context, views: &'a [TopView<'a>]) -> Vec<Model<'a>> {
    [Some(Model::without_speed(context, views)), Model::with_speed(context, views)].into_iter().flatten().collect()
}

/// A model of the motion in all frames.
struct Model<'a> {
    motions: Vec<Motion>,
    views: &'a [TopView<'a>],
    /// Displacements of the points of each frame, m/s.
    displacements: Vec<Vec<Vector2<f64>>>,
    /// Largest ego speed, m/s. Where it is not known it is 1, and durations are displacements in m.
    fastest: f64,
    /// Step of the grid, s or m.
    step: f64,
    speed_known: bool,
}

impl<'a> Model<'a> {
    /// With the motion of the ego vehicle and of the objects, where both are known.
    fn with_speed(context: &Context, views: &'a [TopView<'a>]) -> Option<Model<'a>> {
        let motions = driven(context)?;
        let fastest = motions.iter().map(|m| m.own.speed_m_s().abs()).fold(0.0, f64::max);
        Some(Model::new(views, motions, fastest, STEP_S, true))
    }

    /// With the same displacement in all frames; objects are not displaced.
    fn without_speed(context: &Context, views: &'a [TopView<'a>]) -> Model<'a> {
        Model::new(views, alike(context, OwnMotion::ahead(1.0)), 1.0, STEP_M, false)
    }

    fn new(views: &'a [TopView<'a>], motions: Vec<Motion>, fastest: f64, step: f64, speed_known: bool) -> Model<'a> {
        let longest = step * f64::from(STEPS);
        let of_frame = |(view, motion): (&TopView, &Motion)| view.displacements(motion, longest);
        let displacements = views.par_iter().zip(&motions).map(of_frame).collect();
        Model { motions, views, displacements, fastest, step, speed_known }
    }

    /// Number of the points of a frame in occupied cells if a scan takes `scan_s`.
    fn on(&self, frame: usize, scan_s: f64) -> f64 {
        self.views[frame].on(&self.displacements[frame], scan_s)
    }

    /// Of every frame the numbers of points in occupied cells, for each duration.
    fn counts(&self, frames: &[usize], durations: &[f64]) -> Vec<Vec<f64>> {
        frames.par_iter().map(|&f| durations.iter().map(|&s| self.on(f, s)).collect()).collect()
    }

    /// Number of points of some frames.
    fn points(&self, frames: &[usize]) -> f64 {
        frames.iter().map(|&f| self.displacements[f].len() as f64).sum::<f64>()
    }

    /// Gains of the held-out frames, nats.
    fn held_out_gains(&self, grid: &Grid, fitted: &Fitted, select: &[usize], hold_out: &[usize]) -> Vec<f64> {
        self.gains_of(grid, fitted.extent.scan_s, select, hold_out)
    }

    /// Gain of one more point on the simulation, nats: some lie in occupied cells by chance, so that it is the log odds
    /// ratio of the best and the worst share.
    fn worth(&self, grid: &Grid, select: &[usize]) -> f64 {
        let points = self.points(select);
        let share = |on: f64| ((on + 1.0) / (points + 2.0)).clamp(0.01, 0.99);
        let [chance, there] = grid.ends().map(share);
        (there * (1.0 - chance) / (chance * (1.0 - there))).ln().max(0.0)
    }

    /// The same by a duration of a scan.
    fn gains_of(&self, grid: &Grid, scan_s: f64, select: &[usize], hold_out: &[usize]) -> Vec<f64> {
        let worth = self.worth(grid, select);
        let gain = |&f: &usize| (self.on(f, scan_s) - self.on(f, 0.0)) * self.views[f].each * worth;
        hold_out.iter().map(gain).collect()
    }

    /// Counts on a grid of durations; the gain of a frame is by the best duration of the blocks of other folds.
    fn grid(&self, frames: &[usize], blocks: &[usize]) -> Grid {
        let grid: Vec<f64> = (-STEPS..=STEPS).map(|k| self.step * f64::from(k)).collect();
        let on = self.counts(frames, &grid);
        let still = STEPS as usize;
        let sum = |of: &[usize], k: usize| of.iter().map(|&i| on[i][k]).sum::<f64>();
        let best = |of: &[usize]| (0..grid.len()).max_by(|&a, &b| sum(of, a).total_cmp(&sum(of, b))).unwrap_or(still);
        let gains = cross_validated(blocks, best, |&best, i| on[i][best] - on[i][still]);
        let all: Vec<usize> = (0..frames.len()).collect();
        Grid { gains, sums: grid.iter().enumerate().map(|(k, at)| (*at, sum(&all, k))).collect() }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::inference::roles::roles;
    use crate::pairing::FramePair;
    use crate::pairing::Ray;
    use nalgebra::Vector3;
    use rand::RngExt;
    use sensor::Rig;

    /// Twenty frames of posts, seen at 40 m/s by a scan that takes `scan_s`, counter-clockwise.
    fn found(scan_s: f64) -> Option<f64> {
        let rig = Rig::single();
        let velocity = Vector3::new(-40.0, 0.0, 0.0);
        let frames: Vec<FramePair> = (0..20)
            .map(|f| {
                let mut rng = data::stream(f, "posts", 0, 0);
                let mut place = || rng.random_range(-45.0..45.0f64);
                let posts: Vec<Vector3<f64>> = (0..150).map(|_| Vector3::new(place(), place(), 0.0)).collect();
                let shown = |p: &Vector3<f64>| p + velocity * (p.y.atan2(p.x) / std::f64::consts::TAU * scan_s);
                let measured = posts.iter().map(|p| Ray::standing(&shown(p))).collect();
                FramePair::of_rays(f.to_string(), measured, posts.iter().map(Ray::standing).collect())
            })
            .collect();
        let own = OwnMotion::ahead(40.0);
        let context = Context {
            rig: &rig,
            frames: &frames,
            roles: roles(frames.len()),
            times: Some((0..20).map(|f| 0.05 * f64::from(f)).collect()),
            motion: Some(vec![Some(own); 20]),
            to_next: vec![],
        };
        let (result, slide) = match search(&context) {
            Search::Found(result, slide) => (result, Some(slide)),
            Search::NotFound(result) | Search::Undecided { not_found: result, .. } => (result, None),
        };
        assert_eq!(result.found.len(), usize::from(slide.is_some()));
        let p = Vector3::new(0.0, 20.0, 0.0);
        if let Some(slide) = slide {
            let shift = slide.shift_m(3, &p, 0);
            assert!((shift - velocity * (0.25 * slide.scan_s)).norm() < 1e-9, "{shift}");
        }
        let scan_s = &result.found.first()?.parameters[0].1;
        assert!(scan_s.ci95[0] < scan_s.estimate && scan_s.estimate < scan_s.ci95[1]);
        Some(-scan_s.estimate)
    }

    #[test]
    fn the_duration_of_a_scan_is_found_and_none_where_it_is_zero() {
        for truth in [-0.08, 0.05] {
            let estimate = found(truth).unwrap();
            assert!((estimate - truth).abs() < 0.003, "{estimate} {truth}");
        }
        assert_eq!(found(0.0), None);
    }
}
