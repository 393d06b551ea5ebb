//! Section with training losses and validation AP.

use crate::figure::Figure;
use crate::html::{Item, Section};
use crate::{CurveOptions, ReportError, Series};
use data::DataError;
use serde_json::Value;
use std::path::Path;

/// The curves of one run.
#[derive(Clone, Debug, PartialEq, Default)]
pub struct TrainingRun {
    /// Name in the legend.
    pub name: String,
    /// Step and mean loss over the logged steps of each epoch; before the second epoch, step and loss of each logged
    /// step.
    pub loss: Vec<[f64; 2]>,
    /// Step and AP on the validation split, percent.
    pub validation_ap: Vec<[f64; 2]>,
}

/// Reads the lines of a `metrics.jsonl`. A truncated last line is skipped: the run is being written.
///
/// # Errors
/// A file that cannot be read, or a line that is not valid JSON.
pub(crate) fn metrics_lines(path: &Path) -> Result<Vec<Value>, ReportError> {
    let text = fs_err::read_to_string(path).map_err(DataError::from)?;
    let whole = text.rfind('\n').map_or(0, |end| end + 1);
    let parse = |(i, line): (usize, &str)| {
        let failed = |e| DataError::line(path, i + 1, format!("is not a line of metrics: {e}")).into();
        serde_json::from_str(line).map_err(failed)
    };
    text[..whole].lines().enumerate().map(parse).collect()
}

/// Reads the `metrics.jsonl` of a run folder. A truncated last line is skipped.
///
/// # Errors
/// A file that cannot be read, or a line that is not valid JSON.
pub fn read_training_run(name: &str, path: &Path) -> Result<TrainingRun, ReportError> {
    let (mut of_steps, mut of_epochs) = (Vec::<[f64; 2]>::new(), Vec::new());
    let mut epoch_begins = 0;
    let mut run = TrainingRun { name: name.into(), ..TrainingRun::default() };
    for value in metrics_lines(path)? {
        let at = |key: &str| value[key].as_f64();
        match (value["kind"].as_str(), at("step")) {
            (Some("step"), Some(step)) => of_steps.extend(at("loss").map(|loss| [step, loss])),
            (Some("epoch"), Some(step)) => {
                // The mean in the lines covers one process only, so it would depend on where a run was interrupted.
                let of_epoch = &of_steps[epoch_begins..];
                epoch_begins = of_steps.len();
                if !of_epoch.is_empty() {
                    of_epochs.push([step, of_epoch.iter().map(|p| p[1]).sum::<f64>() / of_epoch.len() as f64]);
                }
                run.validation_ap.extend(value["validation"]["ap"].as_f64().map(|ap| [step, ap]));
            }
            _ => {}
        }
    }
    run.loss = if of_epochs.len() > 1 { of_epochs } else { of_steps };
    Ok(run)
}

/// A figure of losses and one of validation AP.
pub(super) fn section(runs: &[TrainingRun]) -> Section {
    let mut items = Vec::new();
    type Part = (&'static str, &'static str, &'static str, bool, fn(&TrainingRun) -> &Vec<[f64; 2]>);
    let parts: [Part; 2] = [
        ("training-loss", "loss", "Training loss of every run.", true, |run| &run.loss),
        ("validation-ap", "3D AP (%)", "Average precision on the validation split during training.", false, |run| {
            &run.validation_ap
        }),
    ];
    for (id, y_label, caption, log_y, of) in parts {
        let series: Vec<Series> = runs
            .iter()
            .filter(|run| !of(run).is_empty())
            .map(|run| Series { name: run.name.clone(), points: of(run).clone() })
            .collect();
        if series.is_empty() {
            continue;
        }
        let lines: Vec<Vec<String>> = series
            .iter()
            .flat_map(|s| s.points.iter().map(|[step, v]| vec![s.name.clone(), step.to_string(), v.to_string()]))
            .collect();
        let options =
            CurveOptions { x_label: "step".into(), y_label: y_label.into(), log_y, ..CurveOptions::default() };
        items.push(Item::figure(id, caption, Figure::curves(&series, &options), (&["run", "step", "value"], &lines)));
    }
    Section { id: "training", title: "Training", text: Vec::new(), items }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn curves_are_read_from_the_metrics_of_a_run() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("metrics.jsonl");
        let step = "{\"kind\":\"step\",\"step\":1,\"loss\":3.5}\n";
        std::fs::write(&path, format!("{step}{{\"kind\":\"st")).unwrap();
        assert_eq!(read_training_run("a", &path).unwrap().loss, [[1.0, 3.5]]);
        let epoch = |step: u32, ap: &str| {
            format!("{{\"kind\":\"epoch\",\"step\":{step},\"train_loss\":2.0,\"validation\":{ap}}}\n")
        };
        let (first, second) = (epoch(5, "null"), epoch(10, "{\"ap\":40.5}"));
        std::fs::write(&path, format!("{step}{}{first}{step}{second}", step.replace("3.5", "1.5"))).unwrap();
        let run = read_training_run("a", &path).unwrap();
        assert_eq!((run.loss, run.validation_ap), (vec![[5.0, 2.5], [10.0, 3.5]], vec![[10.0, 40.5]]));
        std::fs::write(&path, format!("{step}nonsense\n{step}")).unwrap();
        let error = read_training_run("a", &path).unwrap_err().to_string();
        assert!(error.contains("metrics.jsonl:2"), "{error}");
    }
}
