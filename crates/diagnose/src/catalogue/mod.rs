//! The catalogue: causes, channels, covariates, parameters and units of a diagnosis. Each identifier is an enum with
//! one table that holds its name in `diagnosis.json` and what else is fixed for it.

mod causes;
mod covariates;
mod parameters;
pub mod sizes;

pub use causes::{Cause, Hypothesis, NoiseForm};
pub use covariates::Covariate;
pub use parameters::{ParameterId, Quantity, Unit};

/// Defines an enum of identifiers with their names in `diagnosis.json`. Variants are listed in the order of their
/// names, so that maps by identifier are written in the order of the names; a test holds every table to that.
macro_rules! identifiers {
    ($(#[$about:meta])* $id:ident { $($(#[$doc:meta])* $variant:ident = $name:literal,)* }) => {
        $(#[$about])*
        #[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
        #[derive(serde::Serialize, serde::Deserialize, schemars::JsonSchema)]
        pub enum $id { $($(#[$doc])* #[serde(rename = $name)] $variant,)* }

        impl $id {
            /// All identifiers, in the order of their names.
            pub const ALL: &[$id] = &[$($id::$variant,)*];

            /// The name in `diagnosis.json`.
            pub const fn name(self) -> &'static str {
                match self { $($id::$variant => $name,)* }
            }
        }

        impl std::fmt::Display for $id {
            fn fmt(&self, f: &mut std::fmt::Formatter) -> std::fmt::Result {
                f.write_str(self.name())
            }
        }
    };
}
use identifiers;

identifiers! {
    /// What a finding was found in.
    Channel {
        /// Which returns have a counterpart on the other side.
        Hits = "hits",
        /// Intensities of the returns.
        Intensity = "intensity",
        /// Measured labels against simulated labels.
        Labels = "labels",
        /// Measured returns on labelled objects against simulated ones.
        Objects = "objects",
        /// Shots that follow each other of which no return arrives in single scans.
        Packets = "packets",
        /// Range values as they were measured, for a quantisation.
        Ranges = "ranges",
        /// Distances of measured returns from simulated surfaces.
        Residuals = "residuals",
        /// Returns without a simulated surface at their place.
        Returns = "returns",
        /// Distances of returns from the surface through their own side's neighbours.
        Roughness = "roughness",
        /// Bird's-eye occupancy after undoing a displacement along the scan.
        Slide = "slide",
    }
}

identifiers! {
    /// Kinds of differences of a channel. Each is what its causes make, and says nothing of the others.
    Kind {
        /// Returns behind smooth surfaces.
        Behind = "behind",
        /// Ranges between the two surfaces of an edge.
        Between = "between",
        /// Ranges on bright spots against those on dark ones of the same surface.
        Brightness = "brightness",
        /// Losses in some directions, beyond those of surfaces like theirs, and returns of the ego vehicle.
        Directions = "directions",
        /// Groups of returns where the other side has nothing.
        Groups = "groups",
        /// Lone returns.
        Lone = "lone",
        /// Returns behind vehicles.
        Plumes = "plumes",
        /// Losses by surface, range and incidence.
        Surfaces = "surfaces",
    }
}

impl Kind {
    /// The kind of differences that a cause makes; `None` of causes of channels without kinds.
    pub const fn of(cause: Cause) -> Option<Kind> {
        match cause {
            Cause::DirtyWindow | Cause::EgoOcclusion => Some(Kind::Directions),
            Cause::Fog | Cause::Outliers | Cause::Rain => Some(Kind::Lone),
            Cause::Ghosts => Some(Kind::Behind),
            Cause::IncidenceDropout
            | Cause::MaterialDropout
            | Cause::NearCut
            | Cause::RandomDropout
            | Cause::RangeCut
            | Cause::RangeDropout
            | Cause::SignalDropout => Some(Kind::Surfaces),
            Cause::MissingObject => Some(Kind::Groups),
            Cause::MixedPixels => Some(Kind::Between),
            Cause::ReflectivityWalk => Some(Kind::Brightness),
            Cause::Spray => Some(Kind::Plumes),
            _ => None,
        }
    }

    /// The channel that it is a part of.
    pub const fn channel(self) -> Channel {
        match self {
            Kind::Brightness => Channel::Residuals,
            Kind::Directions | Kind::Surfaces => Channel::Hits,
            _ => Channel::Returns,
        }
    }
}

identifiers! {
    /// Family of causes.
    Family {
        /// Returns are lost.
        Detection = "detection",
        /// Surfaces or objects stand elsewhere, or have another shape.
        Geometry = "geometry",
        /// Labels are displaced.
        Labels = "labels",
        /// Ranges are biased, noisy or rounded.
        RangeError = "range_error",
        /// Returns without a surface, or with another intensity.
        Returns = "returns",
        /// Clocks and the duration of a scan.
        Timing = "timing",
        /// No cause of the catalogue.
        Unknown = "unknown",
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn identifiers_are_listed_in_the_order_of_their_names() {
        let sorted = |names: Vec<&str>| assert!(names.is_sorted(), "{names:?}");
        sorted(Cause::ALL.iter().map(|c| c.name()).collect());
        sorted(Channel::ALL.iter().map(|c| c.name()).collect());
        sorted(Covariate::ALL.iter().map(|c| c.name()).collect());
        sorted(Family::ALL.iter().map(|c| c.name()).collect());
        sorted(Quantity::ALL.iter().map(|c| c.name()).collect());
    }

    #[test]
    fn identifiers_are_written_as_their_names() {
        for cause in Cause::ALL {
            assert_eq!(serde_json::to_value(cause).unwrap(), cause.name());
        }
    }

    #[test]
    fn the_book_has_a_row_for_each_cause_and_the_readme_their_number() {
        let root = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../..");
        let read = |path: &str| std::fs::read_to_string(root.join(path)).unwrap();
        let page = read("docs/src/reference/causes.md");
        let (causes, _) = page.split_once("## Effects of the simulator without a cause").unwrap();
        let rows = causes.lines().filter_map(|line| line.strip_prefix("| `")?.split('`').next());
        let mut described: Vec<&str> = rows.collect();
        described.sort_unstable();
        let named = Cause::ALL.iter().filter(|c| **c != Cause::Unexplained);
        let named: Vec<&str> = named.map(|c| c.name()).collect();
        assert_eq!(described, named);
        // Each effect of the simulator has a cause, or a reason why not.
        let kinds = sensor::Effect::CATALOGUE.iter().map(|(kind, _)| *kind);
        let without: Vec<&str> = kinds.filter(|kind| !page.contains(&format!("`{kind}`"))).collect();
        assert!(without.is_empty(), "{without:?}");
        let number = format!("[{} causes](docs/src/reference/causes.md) for pairs", named.len());
        assert!(read("README.md").contains(&number), "{number}");
    }
}
