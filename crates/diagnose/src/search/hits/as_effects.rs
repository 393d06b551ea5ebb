//! Laws of losses as effects of the simulator.

use super::form::{Corrections, Form as Table};
use crate::effects::rounded;
use crate::inference::law::{FittedLaw, Law, in_zone};
use sensor::effects::{
    AssumedReflectivity, CosineScale, EdgeLoss, Effect, EstimatedIncidence, Form, IncidenceDropout, MaterialDropout,
    OnSurfaces, RandomDropout, RangeDropout, SignalDropout, SurfaceKind,
};
use sensor::signal::{DIAGNOSIS_REFLECTIVITY, index_offset};

impl Corrections {
    /// A law, with these corrections, as the simulator has it; none where the simulation loses more.
    pub(super) fn effects(&self, law: &FittedLaw) -> Vec<Effect> {
        let [place, ln_steepness, ln_skew, ..] = law.numbers;
        if !place.is_finite() {
            return vec![];
        }
        let most = rounded(law.most(), 7);
        let [steepness, skew] = [ln_steepness.exp(), ln_skew.exp()].map(|v| rounded(v.clamp(0.02, 99.0), 7));
        let share = law.numbers[0];
        match law.law {
            Law::Random | Law::Zone(_) if share <= 0.0 => vec![],
            Law::Random => vec![Effect::RandomDropout(RandomDropout { share: rounded(share, 7) })],
            Law::Zone(zone) => {
                let kinds = [SurfaceKind::Ground, SurfaceKind::Standing, SurfaceKind::Bodies, SurfaceKind::Wheels];
                let of_law = kinds.into_iter().enumerate().filter(|(k, _)| in_zone(zone, *k));
                let surfaces = of_law.map(|(_, kind)| kind).collect();
                let share = rounded(share.min(1.0), 7);
                vec![Effect::MaterialDropout(MaterialDropout { materials: vec![], surfaces, share })]
            }
            Law::Range => vec![Effect::RangeDropout(self.by_range(law))],
            Law::Incidence => vec![Effect::IncidenceDropout(IncidenceDropout {
                cos_half: rounded(law.half().clamp(-20.0, 20.0).exp(), 9),
                steepness,
                scale: CosineScale::Log,
                skew,
                most,
                form: table(&self.form, 0.0),
                estimated_incidence: self.estimated(0.0),
            })],
            Law::Signal => vec![Effect::SignalDropout(SignalDropout {
                most,
                threshold: rounded((law.half() + index_offset()).clamp(-20.0, 20.0), 7),
                steepness,
                skew,
                attenuation_per_m: 0.0,
                assumed: Some(assumed(law)),
                form: table(&self.form, index_offset()),
                estimated_incidence: self.estimated(index_offset()),
            })],
        }
    }

    fn by_range(&self, law: &FittedLaw) -> RangeDropout {
        let at = |k: u32| 2f64 * (0.05 * f64::from(k)).exp();
        let range_m: Vec<f64> = (0..100).map(|k| rounded(at(k), 3)).collect();
        let kept = |r: f64| self.form.at(r.ln()) * law.kept_there(r, 1.0);
        let share = range_m.iter().map(|r| rounded((1.0 - kept(*r)).clamp(0.0, 1.0), 5)).collect();
        RangeDropout { range_m, share }
    }

    /// What is lost where the angle of incidence is estimated; `offset` is that of the covariate of the effect from
    /// that of the law.
    fn estimated(&self, offset: f64) -> Option<Box<EstimatedIncidence>> {
        let on_surfaces = |forms: &[Table; 3]| {
            let [ground, standing, objects] = forms.each_ref().map(|form| table(form, offset));
            OnSurfaces { ground, standing, objects }
        };
        let [standing_edges, object_edges] = self.edges.each_ref().map(edge_loss);
        let [fitted, continued] = [&self.fitted, &self.continued].map(on_surfaces);
        let all = EstimatedIncidence { fitted, continued, standing_edges, object_edges };
        (all != EstimatedIncidence::default()).then(|| Box::new(all))
    }
}

fn table(form: &Table, offset: f64) -> Option<Form> {
    let at = form.at.iter().map(|x| rounded(x + offset, 5)).collect();
    let factor = form.factor.iter().map(|f| rounded(*f, 4)).collect();
    (!form.at.is_empty()).then_some(Form { at, factor })
}

fn edge_loss(kept: &Table) -> Option<EdgeLoss> {
    let range_m = kept.at.iter().map(|ln| rounded(ln.exp(), 6)).collect();
    let share = kept.factor.iter().map(|kept| rounded((1.0 - kept).clamp(0.0, 1.0), 5)).collect();
    (!kept.at.is_empty()).then_some(EdgeLoss { range_m, share })
}

/// The reflectivities of a law of the signal, at that of the ground which the diagnosis assumes.
fn assumed(law: &FittedLaw) -> AssumedReflectivity {
    let [.., standing, objects, wheels] =
        law.numbers.map(|ln| rounded((DIAGNOSIS_REFLECTIVITY * ln.exp()).clamp(1e-5, 1e5), 7));
    AssumedReflectivity { ground: DIAGNOSIS_REFLECTIVITY, standing, objects, wheels: Some(wheels) }
}
