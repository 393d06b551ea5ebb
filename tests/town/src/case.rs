//! Cases: a seed, a kind, a size, and what is hidden.

use crate::draw::{CAUSES, OFF_CATALOGUE, draw_effect, is_possible};
use crate::effect::Effect;
use crate::scenario::Scenario;
use crate::sensor::{Layout, Mount, draw_mounts};
use crate::setting::{Intensity, Scene, Setting};
use crate::side::{Nuisances, OwnErrors, Side, isometry, move_houses, real_world};
use crate::world::World;
use data::Stream;
use rand::RngExt;
use score::CaseSize;
use std::sync::Arc;

/// Kind of a case.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// No hidden effect.
    Null,
    /// One effect of [`CAUSES`], by its index.
    Single(usize),
    /// One effect of [`OFF_CATALOGUE`], by its index.
    Off(usize),
    /// So many effects at once, up to two of them of [`OFF_CATALOGUE`].
    Swarm(usize),
    /// So many effects of [`CAUSES`] at once, the same on both sides: nothing that the simulation lacks.
    Alike(usize),
    /// No hidden effect, but each measured frame is taken elsewhere than the log says, its labels with it: up to so
    /// many centimetres, and as many hundredths of a degree.
    Pose(u32),
    /// No hidden effect, but every house is up to 20 cm beside its place in the simulation.
    Buildings,
    /// No hidden effect, frames that follow each other at 20 Hz.
    Consecutive,
    /// 16 rows; nothing hidden or one effect.
    FewRows,
    /// No labels and thirty moving cars; nothing hidden or one effect.
    NoLabels,
    /// At 5 m/s with frames that follow each other; nothing hidden or one effect.
    Crawl,
    /// Between parallel walls; nothing hidden or one effect.
    Parallel,
}

impl Kind {
    /// Names of the kinds, besides those of the causes.
    pub const NAMES: [&str; 12] = [
        "null",
        "single",
        "off",
        "swarm",
        "alike",
        "pose",
        "buildings",
        "consecutive",
        "few_rows",
        "no_labels",
        "crawl",
        "parallel",
    ];

    /// The kind of a name, or of the name of a cause. What the name leaves open is drawn. `swarm` and `alike` may be
    /// followed by a number of effects, `pose` by centimetres.
    pub fn parse(name: &str, rng: &mut Stream) -> Option<Kind> {
        let index = |list: &[&str]| list.iter().position(|c| *c == name);
        let (word, number) = name.split_at(name.find(|c: char| c.is_ascii_digit()).unwrap_or(name.len()));
        let number: Option<usize> = number.parse().ok();
        Some(match (word, number) {
            ("null", None) => Kind::Null,
            ("single", None) => Kind::Single(rng.random_range(0..CAUSES.len())),
            ("off", None) => Kind::Off(rng.random_range(0..OFF_CATALOGUE.len())),
            ("swarm", number) => Kind::Swarm(number.unwrap_or_else(|| draw_number(rng)).clamp(2, 20)),
            ("alike", number) => Kind::Alike(number.unwrap_or_else(|| draw_number(rng)).clamp(1, 20)),
            ("pose", number) => {
                Kind::Pose(number.map_or_else(|| [2, 10, 30][rng.random_range(0..3usize)], |n| n as u32))
            }
            ("buildings", None) => Kind::Buildings,
            ("consecutive", None) => Kind::Consecutive,
            ("few_rows", None) => Kind::FewRows,
            ("no_labels", None) => Kind::NoLabels,
            ("crawl", None) => Kind::Crawl,
            ("parallel", None) => Kind::Parallel,
            _ => match (index(&CAUSES), index(&OFF_CATALOGUE)) {
                (Some(i), _) => Kind::Single(i),
                (_, Some(i)) => Kind::Off(i),
                _ => return None,
            },
        })
    }

    /// Name in the truth file.
    pub fn name(self) -> &'static str {
        match self {
            Kind::Null => "null",
            Kind::Single(_) => "single",
            Kind::Off(_) => "off_catalogue",
            Kind::Swarm(_) => "swarm",
            Kind::Alike(_) => "alike",
            Kind::Pose(_) => "pose",
            Kind::Buildings => "buildings",
            Kind::Consecutive => "consecutive",
            Kind::FewRows => "few_rows",
            Kind::NoLabels => "no_labels",
            Kind::Crawl => "crawl",
            Kind::Parallel => "parallel",
        }
    }
}

/// Number of effects of a swarm: each of the groups of the score is equally frequent.
fn draw_number(rng: &mut Stream) -> usize {
    let [first, last] = score::GROUPS[rng.random_range(0..score::GROUPS.len())];
    rng.random_range(first..=last)
}

/// A case, ready to be written.
#[derive(Clone, Debug)]
pub struct Case {
    /// Random seed.
    pub seed: u64,
    /// Kind.
    pub kind: Kind,
    /// Frames and shots.
    pub size: CaseSize,
    /// Measured side.
    pub measured: Side,
    /// World of the measured side without effects.
    pub real_world: Arc<World>,
    /// Simulated side.
    pub simulated: Side,
}

impl Case {
    /// Effects that the simulated side lacks.
    pub fn hidden(&self) -> &[Effect] {
        if let Kind::Alike(_) = self.kind { &[] } else { &self.measured.effects }
    }
}

/// Fits the setting to the kind.
fn setting_of(kind: Kind, rng: &mut Stream) -> Setting {
    let mut setting = Setting::draw(rng);
    match kind {
        Kind::FewRows => setting.layout = Layout::Roof(16),
        Kind::NoLabels => (setting.labels, setting.cars) = (false, 30),
        Kind::Crawl => (setting.scene, setting.every) = (Scene::Crawl, 1),
        Kind::Parallel => setting.scene = Scene::Parallel,
        Kind::Consecutive => (setting.rate_hz, setting.every) = (20.0, 1),
        Kind::Single(i) => require(CAUSES[i], &mut setting),
        Kind::Off(i) => require(OFF_CATALOGUE[i], &mut setting),
        _ => {}
    }
    setting
}

/// Changes a setting so that an effect is possible.
fn require(cause: &str, setting: &mut Setting) {
    if cause == "sensor_extrinsics" {
        setting.layout = Layout::RoofAndGrille;
    }
    if cause == "beam_intensity" && !setting.intensity.is_of_surface() {
        setting.intensity = Intensity::Counts;
    }
    if !is_possible(cause, setting) {
        setting.layout = Layout::Roof(32);
    }
}

/// The hidden effects of a kind.
fn effects_of(kind: Kind, setting: &Setting, mounts: &[Mount], rng: &mut Stream) -> Vec<Effect> {
    let scan_s = 1.0 / setting.rate_hz;
    let one = |cause: &str, rng: &mut Stream| draw_effect(cause, mounts, scan_s, rng);
    let possible = |list: &[&'static str]| -> Vec<&'static str> {
        list.iter().copied().filter(|cause| is_possible(cause, setting)).collect()
    };
    match kind {
        Kind::Single(i) => vec![one(CAUSES[i], rng)],
        Kind::Off(i) => vec![one(OFF_CATALOGUE[i], rng)],
        Kind::Swarm(number) => {
            let (mut nameable, mut off) = (possible(&CAUSES), possible(&OFF_CATALOGUE));
            let foreign = rng.random_range(0..3usize).min(number / 2);
            let mut effects = Vec::new();
            for k in 0..number {
                let list = if k < foreign { &mut off } else { &mut nameable };
                let cause = list.swap_remove(rng.random_range(0..list.len()));
                effects.push(one(cause, rng));
            }
            effects
        }
        Kind::Alike(number) => {
            let mut nameable = possible(&CAUSES);
            let next = |_| nameable.swap_remove(rng.random_range(0..nameable.len()));
            let causes: Vec<&str> = (0..number).map(next).collect();
            causes.into_iter().map(|cause| one(cause, rng)).collect()
        }
        Kind::FewRows | Kind::NoLabels | Kind::Crawl | Kind::Parallel if rng.random_bool(0.6) => {
            let nameable = possible(&CAUSES);
            vec![one(nameable[rng.random_range(0..nameable.len())], rng)]
        }
        _ => vec![],
    }
}

/// Draws the case of a seed.
pub fn draw_case(seed: u64, kind: Kind, size: CaseSize) -> Case {
    draw(seed, kind, size, false)
}

/// Draws the case of a seed with the simulated side in another town: the same sensors on another drive.
pub fn draw_case_of_two_towns(seed: u64, kind: Kind, size: CaseSize) -> Case {
    draw(seed, kind, size, true)
}

fn draw(seed: u64, kind: Kind, size: CaseSize, two_towns: bool) -> Case {
    let rng = &mut data::stream(seed, "town case", 0, 0);
    let setting = setting_of(kind, rng);
    let (mounts, above_m) = draw_mounts(rng, setting.layout, size.shots, setting.pattern_known);
    let effects = effects_of(kind, &setting, &mounts, rng);
    let duration_s = setting.step_s() * size.frames as f64;
    let scenario = Scenario::draw(&mut data::stream(seed, "town world", 0, 0), &setting, duration_s, above_m);
    let nuisances = Nuisances::draw(rng);
    let real = Arc::new(real_world(&scenario.world, &mut data::stream(seed, "town real world", 0, 0)));
    let mut modelled = scenario.world.clone();
    if kind == Kind::Buildings {
        move_houses(&mut modelled, 0.2, &mut data::stream(seed, "town buildings", 0, 0));
    }
    let mut own = OwnErrors::small(rng, size.frames, setting.step_s());
    if let Kind::Pose(centimetres) = kind {
        let most = f64::from(centimetres);
        for displacement in &mut own.displacement {
            let shift = [(); 3].map(|()| 0.01 * most * rng.random_range(-1.0..1.0));
            let turn = [(); 3].map(|()| (0.01 * most).to_radians() * rng.random_range(-1.0..1.0));
            *displacement = isometry(shift, turn);
        }
    }
    let elsewhere = two_towns
        .then(|| Scenario::draw(&mut data::stream(seed, "town other world", 0, 0), &setting, duration_s, above_m));
    let elsewhere = elsewhere.map(|other| (Arc::new(other.world.clone()), Arc::new(other)));
    let simulated = Side {
        name: "simulated",
        seed,
        setting,
        scenario: Arc::new(scenario),
        world: Arc::new(modelled),
        rows: crate::side::draw_rows(&mounts, &[], seed),
        mounts: Arc::new(mounts),
        nuisances,
        own: Arc::new(OwnErrors::none(rng, size.frames, setting.step_s())),
        effects: vec![],
        duration_s,
    };
    let measured = Side { name: "measured", own: Arc::new(own), ..simulated.clone() }.with_effects(&real, effects);
    let simulated = match kind {
        Kind::Alike(_) => simulated.with_effects(&simulated.world, measured.effects.clone()),
        _ => simulated,
    };
    let simulated = match elsewhere {
        Some((world, scenario)) => Side { world, scenario, ..simulated },
        None => simulated,
    };
    Case { seed, kind, size, measured, real_world: real, simulated }
}
