//! One measured frame in 3D, coloured by its discrepancy from the simulation, with findings applied and not.

use super::finding_name;
use crate::html::{Item, Section, ViewTexts};
use crate::page::Rgb;
use crate::scene::{ColoredCloud, Layer, LayerContent, Scene};
use data::Cloud;
use diagnose::{Diagnosis, Discrepancy, Switch, View, ViewState};

/// Colours of the least, the middle and the largest value: blue and orange differ to colour-blind readers as well.
const SCALE: [Rgb; 3] = [[0, 90, 200], [150, 154, 158], [230, 90, 0]];

/// Colour of measured returns that the simulation does not have.
const EXTRA: &str = "#aa3377";

/// Colour of simulated returns that the measured frame does not have.
const LOST: &str = "#b8a100";

/// Steps of the scale. The middle one is grey.
const STEPS: usize = 15;

/// Share of the values without the finding that the scale holds.
const SHOWN: f64 = 0.9;

/// Ends that a scale can have.
const ENDS: [f64; 11] = [0.005, 0.01, 0.02, 0.03, 0.05, 0.1, 0.2, 0.3, 0.5, 1.0, 2.0];

/// The section with the view; without items where there is none.
pub(super) fn section(d: &Diagnosis, view: Option<&View>) -> Section {
    let (text, items) = view.map_or_else(Default::default, |view| (text(view), vec![item(d, view)]));
    Section { id: "frame-3d", title: "One frame in 3D", text, items }
}

fn text(view: &View) -> Vec<String> {
    let many = "Choose a finding and switch it off and on: all other findings stay applied to the simulation, so that what changes is \
                this finding alone. \"All findings\" switches between the simulation as it is and the extended one.";
    let one = "Switch it off and on: off is the simulation as it is, on is the extended simulation.";
    vec![
        format!(
            "The measured frame {}: of the frames on which nothing was fitted, the one that differs most from the simulation in what \
             was found.",
            view.frame
        ),
        if view.switches.len() > 1 { many } else { one }.into(),
        "Where the simulation agrees, returns are grey. A right finding takes the colours away; what stays coloured with all findings \
         on is not explained."
            .into(),
    ]
}

fn item(d: &Diagnosis, view: &View) -> Item {
    let scenes: Vec<Scene> = view.switches.iter().map(|switch| scene(d, view, switch)).collect();
    let caption = "Measured returns in the frame of the clouds. Ranges: how much nearer or farther a return is than the simulated surface in its \
                   direction, along the ray. Scatter and intensity: of the returns within 6 by 4 degrees around it. Losses, false returns and \
                   noise are drawn at random, so that only the number is shown by which one side has more within 6 by 4 degrees; some points \
                   of either colour stay in any case. Findings that do not change the returns of this frame, such as those of labels, cannot \
                   be switched. Drag to turn, scroll or pinch to come nearer.";
    let texts = ViewTexts {
        list: "Finding",
        switch: Some("applied to the simulation"),
        without: "; the figures above show every finding before and after",
    };
    Item::view("frame", caption, &scenes, texts)
}

fn scene(d: &Diagnosis, view: &View, switch: &Switch) -> Scene {
    let finding = switch.finding.and_then(|number| Some((number, d.findings.get(number)?)));
    let name = finding.map_or("All findings".into(), |(number, f)| format!("{}. {}", number + 1, finding_name(f)));
    let end = end_of_scale(switch);
    let layers = |state: &ViewState| {
        let mut layers = vec![measured(&view.points_m, state, switch.discrepancy, end)];
        if switch.discrepancy == Discrepancy::Range {
            let content = LayerContent::Cloud(cloud(&state.lost_m));
            layers.push(Layer { name: "simulated, not measured".into(), color: LOST.into(), content });
        }
        layers
    };
    Scene { name, layers: layers(&switch.off), on: Some(layers(&switch.on)), focus_m: None }
}

fn cloud(points_m: &[[f32; 3]]) -> Cloud {
    Cloud { values: points_m.concat(), channels: 3 }
}

/// The layer of measured returns; the scale goes from `-end` to `end`.
fn measured(points_m: &[[f32; 3]], state: &ViewState, discrepancy: Discrepancy, end: f64) -> Layer {
    let color = |value: &Option<f32>| value.map_or(STEPS as u8, |v| step(f64::from(v) / end));
    let mut palette: Vec<String> = (0..STEPS).map(|k| css(color_at(k as f64 / (STEPS - 1) as f64))).collect();
    let gradient = format!("linear-gradient(to right, {})", SCALE.map(css).join(", "));
    let [low, high] = ends(discrepancy, end);
    let mut legend = vec![(String::new(), low), (gradient, high)];
    if discrepancy == Discrepancy::Range {
        palette.push(EXTRA.into());
        legend.push((EXTRA.into(), "measured, not simulated".into()));
    }
    let colors = state.values.iter().map(color).collect();
    let content = LayerContent::Colored(ColoredCloud { cloud: cloud(points_m), colors, palette, legend });
    Layer { name: "measured".into(), color: String::new(), content }
}

/// What stands at the two ends of the scale.
fn ends(discrepancy: Discrepancy, end: f64) -> [String; 2] {
    match discrepancy {
        Discrepancy::Range => [format!("measured {end} m nearer"), format!("{end} m farther than simulated")],
        Discrepancy::Scatter => {
            [format!("measured ranges scatter {end} m less"), format!("{end} m more than simulated")]
        }
        Discrepancy::Intensity => {
            let factor = end.exp();
            [format!("measured intensity {factor:.2} times lower"), format!("{factor:.2} times higher than simulated")]
        }
    }
}

/// The step of the scale of a value from -1 to 1; larger ones are at its ends.
fn step(value: f64) -> u8 {
    let steps = STEPS as f64;
    // A value that is no number converts to the first step.
    ((value + 1.0) / 2.0 * steps).clamp(0.0, steps - 1.0) as u8
}

/// The colour at a share of the scale.
fn color_at(share: f64) -> Rgb {
    let [low, middle, high] = SCALE;
    let (from, to, at) = if share < 0.5 { (low, middle, 2.0 * share) } else { (middle, high, 2.0 * share - 1.0) };
    [0, 1, 2].map(|k| (f64::from(from[k]) + at * (f64::from(to[k]) - f64::from(from[k]))).round() as u8)
}

fn css([r, g, b]: Rgb) -> String {
    format!("#{r:02x}{g:02x}{b:02x}")
}

/// The end of the scale: the first of [`ENDS`] that holds most values without the finding, between the least and the
/// most that is of use.
fn end_of_scale(switch: &Switch) -> f64 {
    let [least, most] = match switch.discrepancy {
        Discrepancy::Range => [0.05, 0.5],
        Discrepancy::Scatter => [0.005, 0.2],
        Discrepancy::Intensity => [0.1, 2.0],
    };
    let mut values: Vec<f64> = switch.off.values.iter().flatten().map(|v| f64::from(v.abs())).collect();
    values.sort_by(f64::total_cmp);
    let held = values.get((values.len() as f64 * SHOWN) as usize).copied().unwrap_or(0.0);
    ENDS.into_iter().filter(|end| (least..=most).contains(end)).find(|end| *end >= held).unwrap_or(most)
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use crate::scene::scenes_json;

    /// A switch of the first finding with these values without it, and none with it.
    pub(crate) fn switch(discrepancy: Discrepancy, off: &[Option<f32>]) -> Switch {
        let on = ViewState { values: vec![Some(0.0); off.len()], lost_m: vec![] };
        let off = ViewState { values: off.to_vec(), lost_m: vec![[1.0, 2.0, 3.0]] };
        Switch { finding: Some(0), discrepancy, off, on }
    }

    fn colors(layer: &Layer) -> &[u8] {
        let LayerContent::Colored(colored) = &layer.content else { panic!("{layer:?}") };
        assert!(colored.colors.iter().all(|color| usize::from(*color) < colored.palette.len()), "{layer:?}");
        &colored.colors
    }

    #[test]
    fn colours_say_on_which_side_and_by_how_much() {
        for (value, expected) in
            [(0.0, 7), (0.06, 7), (0.25, 9), (-0.25, 5), (1.0, 14), (-1.0, 0), (9.0, 14), (-9.0, 0), (f64::NAN, 0)]
        {
            assert_eq!(step(value), expected, "{value}");
        }
        assert_eq!([0.0, 0.5, 1.0].map(color_at), SCALE);
    }

    #[test]
    fn the_scale_holds_most_values_and_is_a_round_number() {
        let ends = |discrepancy, value: f32| end_of_scale(&switch(discrepancy, &[Some(-value), Some(value), None]));
        for (discrepancy, value, end) in [
            (Discrepancy::Range, 0.0, 0.05),
            (Discrepancy::Range, 0.12, 0.2),
            (Discrepancy::Range, 0.21, 0.3),
            (Discrepancy::Range, 3.0, 0.5),
            (Discrepancy::Scatter, 0.012, 0.02),
            (Discrepancy::Intensity, 0.6, 1.0),
        ] {
            assert_eq!(ends(discrepancy, value), end, "{discrepancy:?} {value}");
        }
        // One far return of twenty does not stretch it.
        let mut values = vec![Some(0.07); 20];
        values[3] = Some(30.0);
        assert_eq!(end_of_scale(&switch(Discrepancy::Range, &values)), 0.1);
    }

    #[test]
    fn a_finding_is_a_scene_with_two_states() {
        let d = crate::pages::diagnosis::page::tests::diagnosis(vec![super::super::tests::loss_by_row()]);
        let view = |switches| View { frame: "000007".into(), points_m: vec![[1.0, 2.0, 3.0]; 3], switches };
        let of_ranges = switch(Discrepancy::Range, &[Some(0.0), Some(0.19), None]);
        let shown = scene(&d, &view(vec![]), &of_ranges);
        assert_eq!(shown.name, "1. unexplained");
        let [off, lost] = &shown.layers[..] else { panic!("{shown:?}") };
        let Some([on, none_lost]) = shown.on.as_deref() else { panic!("{shown:?}") };
        assert_eq!((colors(off), colors(on)), (&[7, 14, 15][..], &[7, 7, 7][..]));
        for (layer, points) in [(lost, 1), (none_lost, 0)] {
            let LayerContent::Cloud(cloud) = &layer.content else { panic!("{layer:?}") };
            assert_eq!((layer.name.as_str(), cloud.len()), ("simulated, not measured", points));
        }
        let text = scenes_json(&[shown]);
        for words in ["measured 0.2 m nearer", "0.2 m farther than simulated", "measured, not simulated"] {
            assert!(text.contains(words), "{words} {text}");
        }
        let all = Switch { finding: None, ..of_ranges };
        assert_eq!(scene(&d, &view(vec![]), &all).name, "All findings");
        // Scatter has no colour for returns without a counterpart, and none are lost.
        let scatter = scene(&d, &view(vec![]), &switch(Discrepancy::Scatter, &[Some(0.02)]));
        assert!(scatter.layers.len() == 1 && !scenes_json(&[scatter]).contains("not simulated"));
        // Without any return it is empty, and no more.
        let empty = View { points_m: vec![], ..view(vec![switch(Discrepancy::Intensity, &[])]) };
        assert_eq!(section(&d, Some(&empty)).items.len(), 1);
        assert_eq!(section(&d, None).items.len(), 0);
    }
}
