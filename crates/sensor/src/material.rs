//! Surface materials and their reflectance.

use data::KeyError;
use data::toml_text::{within, wrong};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// Index in a [`MaterialTable`].
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Default)]
pub struct MaterialId(pub u8);

/// Reflectance of a surface at the laser's wavelength.
///
/// At an angle of incidence i, the returned light is `reflectivity * f(cos i)` relative to a white Lambertian plate at
/// normal incidence, where `f(c) = (1 - lobe) * c + lobe * c^exponent`: a Lambertian part and a lobe towards the
/// sensor, f(1) = 1. Tyres and mats are Lambertian (lobe 0); paint and metal return most light at normal incidence
/// (Muckenhuber et al. 2020 measured such curves for automotive materials at 905 nm).
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Material {
    /// Reflectivity at normal incidence, relative to a white plate. 0.04 rubber, 0.2 asphalt, 0.5 paint; above 1 for
    /// retro-reflectors.
    pub reflectivity: f64,
    /// Fraction of the light in the lobe, 0 to 1.
    #[serde(default)]
    pub lobe: f64,
    /// Exponent of the lobe, at least 1; larger is narrower.
    #[serde(default = "one")]
    pub exponent: f64,
}

fn one() -> f64 {
    1.0
}

impl Material {
    /// Returned light at this cosine of incidence, relative to a white Lambertian plate at normal incidence.
    pub fn returned(&self, cos_incidence: f64) -> f64 {
        let c = cos_incidence.clamp(0.0, 1.0);
        self.reflectivity * ((1.0 - self.lobe) * c + self.lobe * c.powf(self.exponent))
    }

    fn check(&self) -> Result<(), KeyError> {
        within("reflectivity", self.reflectivity, 0.0, 1000.0)?;
        within("lobe", self.lobe, 0.0, 1.0)?;
        within("exponent", self.exponent, 1.0, 1000.0)
    }
}

/// Name, reflectivity, lobe, exponent. Typical near-infrared values; tyres, carbon and paint follow the ranges in
/// Muckenhuber et al. 2020.
const BUILT_IN: [(&str, f64, f64, f64); 20] = [
    ("asphalt", 0.20, 0.0, 1.0),
    ("apron", 0.24, 0.0, 1.0),
    ("marking", 0.60, 0.0, 1.0),
    ("grass", 0.40, 0.0, 1.0),
    ("sand", 0.45, 0.0, 1.0),
    ("concrete", 0.35, 0.0, 1.0),
    ("wall", 0.55, 0.2, 8.0),
    ("steel", 0.50, 0.5, 12.0),
    ("wire", 0.40, 0.3, 8.0),
    ("plaster", 0.50, 0.0, 1.0),
    ("seats", 0.35, 0.0, 1.0),
    ("leaves", 0.40, 0.0, 1.0),
    ("paint", 0.45, 0.5, 20.0),
    ("carbon", 0.08, 0.4, 20.0),
    ("rubber", 0.04, 0.0, 1.0),
    ("metal", 0.50, 0.6, 20.0),
    ("glass", 0.06, 0.8, 60.0),
    ("reflector", 20.0, 0.0, 1.0),
    ("fabric", 0.30, 0.0, 1.0),
    ("unknown", 0.20, 0.0, 1.0),
];

/// Materials by name and index.
#[derive(Clone, Debug, PartialEq)]
pub struct MaterialTable {
    names: Vec<String>,
    materials: Vec<Material>,
}

impl Default for MaterialTable {
    fn default() -> Self {
        let material = |(_, reflectivity, lobe, exponent)| Material { reflectivity, lobe, exponent };
        MaterialTable {
            names: BUILT_IN.iter().map(|m| m.0.into()).collect(),
            materials: BUILT_IN.into_iter().map(material).collect(),
        }
    }
}

impl MaterialTable {
    /// The built-in materials with changes and additions. Errors name the key.
    pub fn with(changes: &BTreeMap<String, Material>) -> Result<Self, KeyError> {
        let mut table = MaterialTable::default();
        for (name, material) in changes {
            material.check().map_err(|e| e.below(name))?;
            match table.names.iter().position(|n| n == name) {
                Some(i) => table.materials[i] = *material,
                None if table.names.len() < 255 => {
                    table.names.push(name.clone());
                    table.materials.push(*material);
                }
                None => return Err(wrong(name.clone(), "there are more than 255 materials")),
            }
        }
        Ok(table)
    }

    /// A table of these names in this order, as in a data set's attributes. Names without a built-in material get the
    /// reflectance of "unknown".
    pub fn named(names: &[String]) -> Self {
        let built_in = MaterialTable::default();
        let material = |name: &String| *built_in.get(built_in.find(name).unwrap_or(MaterialTable::built_in("unknown")));
        MaterialTable { names: names.to_vec(), materials: names.iter().map(material).collect() }
    }

    /// Index of a name.
    pub fn find(&self, name: &str) -> Option<MaterialId> {
        self.names.iter().position(|n| n == name).map(|i| MaterialId(i as u8))
    }

    /// Index of a built-in name.
    pub fn built_in(name: &str) -> MaterialId {
        let place = BUILT_IN.iter().position(|m| m.0 == name);
        MaterialId(place.unwrap_or_else(|| panic!("{name} is in the list of built-in materials")) as u8)
    }

    /// Material of an index.
    pub fn get(&self, id: MaterialId) -> &Material {
        &self.materials[usize::from(id.0)]
    }

    /// Name of an index.
    pub fn name(&self, id: MaterialId) -> &str {
        &self.names[usize::from(id.0)]
    }

    /// All names, by index.
    pub fn names(&self) -> &[String] {
        &self.names
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn light_falls_with_incidence() {
        for id in 0..BUILT_IN.len() as u8 {
            let material = *MaterialTable::default().get(MaterialId(id));
            material.check().unwrap();
            assert!((material.returned(1.0) - material.reflectivity).abs() < 1e-12);
            assert_eq!(material.returned(0.0), 0.0);
            let curve: Vec<f64> = (0..=20).map(|i| material.returned(f64::from(i) / 20.0)).collect();
            assert!(curve.windows(2).all(|w| w[0] <= w[1]), "{curve:?}");
        }
        let paint = Material { reflectivity: 0.5, lobe: 0.5, exponent: 20.0 };
        assert!((paint.returned(0.5) - 0.5 * (0.25 + 0.5 * 0.5_f64.powi(20))).abs() < 1e-12);
    }

    #[test]
    fn materials_can_be_changed_and_added() {
        let grey = Material { reflectivity: 0.18, lobe: 0.0, exponent: 1.0 };
        let table = MaterialTable::with(&[("rubber".into(), grey), ("card".into(), grey)].into()).unwrap();
        assert_eq!(table.get(MaterialTable::built_in("rubber")), &grey);
        assert_eq!(table.name(table.find("card").unwrap()), "card");
        assert_eq!(table.find("cardboard"), None);
        let bad = Material { lobe: 1.5, ..grey };
        let error = MaterialTable::with(&[("card".into(), bad)].into()).unwrap_err().to_string();
        assert_eq!(error, "card.lobe: 1.5 is not between 0 and 1");
    }
}
