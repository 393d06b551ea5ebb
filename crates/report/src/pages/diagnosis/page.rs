//! The page of a diagnosis: the result in three sentences, the findings with what to change, a figure of each, one
//! frame in 3D, the gain by channel, and what was looked for and not found.

use super::{figure, finding_name, view};
use crate::ReportError;
use crate::html::{Item, PageText, Section, TableCell, TableRow, page};
use crate::link::Link;
use crate::pages::study::number;
use data::write_atomic;
use diagnose::{Diagnosis, Finding, ParameterId, Status, Unit, Verdict, View, what_to_change};
use std::path::Path;

/// Content of the page.
#[derive(Clone, Debug)]
pub struct DiagnosisReport<'a> {
    /// The diagnosis.
    pub diagnosis: &'a Diagnosis,
    /// One frame with findings applied and not.
    pub view: Option<&'a View>,
    /// Other pages about the same data.
    pub links: Vec<Link>,
    /// What was compared: names of the measured and of the simulated data set.
    pub title: String,
    /// The command that made it.
    pub command: String,
}

impl DiagnosisReport<'_> {
    /// Renders the page. It is self-contained and needs no network.
    ///
    /// # Errors
    /// A page that cannot be rendered.
    pub fn html(&self) -> Result<String, ReportError> {
        let d = self.diagnosis;
        let [found, figures, frame] = [findings(d), pictures(d), view::section(d, self.view)];
        let [gone, detectors] = [gain(d), detectors(d)];
        let mut sections =
            vec![found, figures, frame, gone, detectors, not_found(d), not_identifiable(d), considered(d)];
        sections.retain(|section| !section.items.is_empty());
        let left =
            d.gain.not_applied.iter().map(|n| format!("Not applied, and counted as not gone: {}: {}", n.effect, n.why));
        let warnings: Vec<String> = d.notes.iter().cloned().chain(left).collect();
        let build = if d.build.is_empty() { String::new() } else { format!(" (lidarshift {})", d.build) };
        let footer =
            format!("Made by: {}{build}. One file: figures and numbers are inside; nothing is loaded.", self.command);
        let title = format!("lidarshift diagnose: {}", self.title);
        let (about, links) = (&about(d)[..], &self.links[..]);
        page(&PageText { title: &title, about, links, warnings: &warnings, footer: &footer }, &mut sections)
    }

    /// Writes `report.html` into a folder.
    ///
    /// # Errors
    /// A file that cannot be written.
    pub fn write(&self, folder: &Path) -> Result<(), ReportError> {
        Ok(write_atomic(&folder.join("report.html"), self.html()?.as_bytes())?)
    }
}

fn percent(share: f64) -> String {
    format!("{:.0} %", 100.0 * share)
}

/// An interval of shares, in brackets; empty without one.
fn between(ci95: Option<[f64; 2]>) -> String {
    ci95.map_or(String::new(), |[low, high]| format!(" ({:.0} to {:.0} %)", 100.0 * low, 100.0 * high))
}

/// The result in three sentences.
fn about(d: &Diagnosis) -> Vec<String> {
    let count = |status: Status| d.findings.iter().filter(|f| f.status == status).count();
    let names = |status: Status| {
        let of = d.findings.iter().filter(|f| f.status == status).map(finding_name);
        of.collect::<Vec<_>>().join(", ")
    };
    let verdict = match d.verdict {
        Verdict::NotScenarioIdentical => "The two data sets do not show the same scenes.".to_owned(),
        Verdict::TooFewFrames => "There are too few frames to find, fit and test anything.".into(),
        Verdict::NothingFound => "No difference between the measured and the simulated data is significant.".into(),
        _ => {
            let named = match count(Status::Named) {
                0 => "no cause could be named".to_owned(),
                n => format!("{n} with a named cause ({})", names(Status::Named)),
            };
            let of = |n: usize, text: &str| if n > 0 { format!(", {n} {text}") } else { String::new() };
            format!(
                "{} differences were found: {named}{}{}{}.",
                d.findings.len(),
                of(count(Status::Ambiguous), "that several causes explain equally well"),
                of(count(Status::Unexplained), "that no cause of the catalogue explains"),
                of(count(Status::NotIdentifiable), "whose cause this pair cannot tell")
            )
        }
    };
    let closed = match d.gain.closed {
        Some(share) => format!(
            "With the effects of extended.toml, {} of the difference is gone{}, measured on simulated frames that were made anew and on \
             measured frames on which nothing was fitted.",
            percent(share),
            between(d.gain.ci95)
        ),
        None if d.findings.is_empty() => {
            "Nothing has to be changed in the simulation as far as these frames tell.".into()
        }
        None => "None of this could be put into the simulated data, so that no gain was measured.".into(),
    };
    let [select, estimate, hold_out] = [&d.frames.select, &d.frames.estimate, &d.frames.hold_out].map(Vec::len);
    let frames = format!(
        "Causes were chosen on {select} frames, fitted on {estimate} others, and tested on {hold_out} more; intervals are of 95 %."
    );
    match d.verdict {
        Verdict::NotScenarioIdentical | Verdict::TooFewFrames => vec![verdict],
        _ => vec![verdict, closed, frames],
    }
}

/// Digits that an estimate of this size needs.
fn rounded(value: f64) -> String {
    let digits = if value == 0.0 { 0.0 } else { (2.0 - value.abs().log10().floor()).clamp(0.0, 6.0) };
    format!("{value:.*}", digits as usize)
}

/// A number with its unit; shares have none.
fn with_unit(value: f64, unit: Unit) -> String {
    match unit {
        Unit::One | Unit::Number => rounded(value),
        unit => format!("{} {unit}", rounded(value)),
    }
}

/// The parameters of a finding with their intervals, without tables by row.
fn parameters(finding: &Finding) -> String {
    let of_cause = |id: &ParameterId| matches!(id, ParameterId::Of(_));
    let one = |(id, p): (&ParameterId, &diagnose::Parameter)| match p.unit {
        Unit::Number => format!("{id} {}", rounded(p.estimate)),
        unit => {
            let [low, high] = p.ci95.map(rounded);
            format!("{id} {} ({low} to {high})", with_unit(p.estimate, unit))
        }
    };
    let shown: Vec<String> = finding.parameters.iter().filter(|(id, _)| of_cause(id)).map(one).collect();
    let rows = finding.parameters.len() - shown.len();
    let table = (rows > 0).then(|| format!("a table of {rows} rows in diagnosis.json"));
    shown.into_iter().chain(table).collect::<Vec<_>>().join("; ")
}

/// A table of these rows; none without rows.
fn if_any(id: &str, caption: &str, columns: (&[&str], usize), rows: Vec<TableRow>) -> Vec<Item> {
    if rows.is_empty() { vec![] } else { vec![Item::table(id, caption, columns, rows, None)] }
}

fn findings(d: &Diagnosis) -> Section {
    let total: f64 = d.findings.iter().map(|f| f.gain.nats_per_ray.max(0.0)).sum();
    let row = |f: &Finding| {
        let status = match f.status {
            Status::Named => "named",
            Status::Ambiguous => "ambiguous",
            Status::Unexplained => "without a name",
            Status::NotIdentifiable => "not identifiable",
        };
        let share = if total > 0.0 { percent(f.gain.nats_per_ray.max(0.0) / total) } else { "–".into() };
        let reached = f.reached.map_or_else(|| "–".into(), percent);
        let tell = f.separate_by.as_ref().map_or(String::new(), |how| match f.status {
            Status::NotIdentifiable => format!("To tell it, record {how}."),
            _ => format!("To distinguish the causes, record {how}."),
        });
        TableRow::new(
            false,
            [
                TableCell::with_small(finding_name(f), status),
                TableCell::with_small(f.says.clone(), parameters(f)),
                TableCell::with_small(what_to_change(f), tell),
                TableCell::with_small(share, f.channel.name()),
                TableCell::new(reached),
                TableCell::new(percent(f.confidence)),
            ],
        )
    };
    let rows: Vec<TableRow> = d.findings.iter().map(row).collect();
    let columns = ["finding", "what is measured", "what to change", "share", "gone in its channel", "same choice"];
    let caption = "What differs, the largest first. \"Share\" is the part of the gain of all findings. \"Gone in its channel\" is the share of \
                   the channel's difference that is gone with the extended simulation. \"Same choice\" is how often resampled frames choose \
                   the same cause.";
    let items = if_any("findings", caption, (&columns, 3), rows);
    Section { id: "found", title: "What differs", text: vec![], items }
}

fn pictures(d: &Diagnosis) -> Section {
    let shown = d.findings.iter().enumerate().filter(|(_, f)| !f.curve.points.is_empty());
    let item = |(i, f): (usize, &Finding)| {
        let columns = ["sensor", "x", "measured", "simulated", "simulated with the finding", "standard error"];
        let line = |p: &diagnose::CurvePoint| {
            let values = [p.x, p.measured, p.before, p.after, p.error].map(|v| v.to_string());
            std::iter::once(p.sensor.to_string()).chain(values).collect::<Vec<_>>()
        };
        let lines: Vec<Vec<String>> = f.curve.points.iter().map(line).collect();
        let caption = format!("{}: {}.", finding_name(f), f.says);
        Item::figure(format!("finding-{}", i + 1), caption, figure(f), (&columns, &lines))
    };
    Section { id: "figures", title: "Each finding, before and after", text: vec![], items: shown.map(item).collect() }
}

fn gain(d: &Diagnosis) -> Section {
    let row = |(channel, [before, after, floor]): (&diagnose::Channel, &[f64; 3])| {
        let closed = d.gain.closed_by_channel.get(channel);
        let numbers = [before, after, floor].map(|v| TableCell::new(number(Some(*v), 5)));
        let gone = closed.map_or_else(|| "–".into(), |c| format!("{}{}", percent(c.closed), between(c.ci95)));
        TableRow::new(
            false,
            std::iter::once(TableCell::new(channel.name())).chain(numbers).chain([TableCell::new(gone)]),
        )
    };
    let rows: Vec<TableRow> = d.gain.channels.iter().map(row).collect();
    let columns = ["channel", "before", "after", "two draws of the extended simulation", "gone"];
    let caption = "What tables of the measured data predict better than the simulation, by channel, in nats for each simulated return: 0 where \
                   nothing differs. A dash: too small to be compared.";
    let items = if_any("gain", caption, (&columns, 1), rows);
    Section { id: "gone", title: "What the extended simulation takes away", text: vec![], items }
}

fn detectors(d: &Diagnosis) -> Section {
    let row = |g: &diagnose::DetectorGain| {
        let numbers = [g.before, g.after, g.ceiling].map(|v| TableCell::new(number(Some(v), 1)));
        let interval = g.ci95.map_or(String::new(), |[low, high]| format!("{low:.1} to {high:.1}"));
        let name = format!("{}, {}, IoU {}", g.detector, g.class, g.overlap);
        let gained = TableCell::with_small(format!("{:+.1}", g.gain), interval);
        TableRow::new(false, std::iter::once(TableCell::new(name)).chain(numbers).chain([gained]))
    };
    let rows: Vec<TableRow> = d.detectors.iter().map(row).collect();
    let columns = ["detector", "trained on simulated", "on extended", "on measured", "gain"];
    let caption = "Average precision on measured frames that neither the diagnosis nor the training used.";
    let items = if_any("detectors", caption, (&columns, 1), rows);
    Section { id: "detectors-gain", title: "What detectors gain", text: vec![], items }
}

fn not_found(d: &Diagnosis) -> Section {
    let found = |cause: &diagnose::Cause| d.findings.iter().any(|f| f.may_be(*cause));
    let row = |(cause, m): (&diagnose::Cause, &diagnose::Minimum)| {
        TableRow::new(
            false,
            [
                TableCell::new(cause.name()),
                TableCell::new(m.parameter.to_string()),
                TableCell::new(with_unit(m.value, m.unit)),
            ],
        )
    };
    let rows: Vec<TableRow> = d.minimum_detectable.iter().filter(|(cause, _)| !found(cause)).map(row).collect();
    let columns = ["cause", "parameter", "smallest size"];
    let caption =
        "Causes that were looked for and not found, with the smallest size that would have been found in these data.";
    let items = if_any("minimum", caption, (&columns, 2), rows);
    Section { id: "not-found", title: "What was not found", text: vec![], items }
}

fn not_identifiable(d: &Diagnosis) -> Section {
    let row = |n: &diagnose::Unidentifiable| {
        let cells = [n.cause.name().to_owned(), n.why.clone(), n.tell_by.clone()];
        TableRow::new(false, cells.map(TableCell::new))
    };
    let rows: Vec<TableRow> = d.not_identifiable.iter().map(row).collect();
    let columns = ["cause", "why not", "what to record"];
    let caption = "Causes that these data cannot tell, whatever their size.";
    let items = if_any("not-identifiable-causes", caption, (&columns, 3), rows);
    Section { id: "not-identifiable", title: "What these data cannot tell", text: vec![], items }
}

fn considered(d: &Diagnosis) -> Section {
    let row = |c: &diagnose::Considered| {
        TableRow::new(
            false,
            [
                TableCell::new(c.cause.to_string()),
                TableCell::new(c.channel.name()),
                TableCell::new(c.outcome.clone()),
                TableCell::new(number(Some(c.nats_per_ray), 5)),
                TableCell::new(number(Some(c.z), 1)),
            ],
        )
    };
    let rows: Vec<TableRow> = d.considered.iter().map(row).collect();
    let columns = ["hypothesis", "channel", "what became of it", "gain, nats a return", "gain over its standard error"];
    let caption = "Every hypothesis, in the order in which it was tried.";
    let items = if_any("considered", caption, (&columns, 3), rows);
    Section { id: "hypotheses", title: "All hypotheses", text: vec![], items }
}

#[cfg(test)]
pub(super) mod tests {
    use super::super::tests::loss_by_row;
    use super::super::view::tests::switch;
    use super::*;
    use diagnose::{Cause, Discrepancy, Gain, Minimum, Parameter, Quantity, Unidentifiable};

    pub(crate) fn diagnosis(findings: Vec<Finding>) -> Diagnosis {
        Diagnosis {
            schema: diagnose::SCHEMA.into(),
            build: "0.1.0+abc".into(),
            verdict: Verdict::of(&findings),
            frames: Default::default(),
            findings,
            minimum_detectable: [(Cause::RangeNoise, Minimum::new(Quantity::StdM, 0.0031))].into(),
            gain: Gain { closed: Some(0.83), ci95: Some([0.7, 0.9]), ..Gain::default() },
            detectors: vec![],
            not_identifiable: vec![Unidentifiable {
                cause: Cause::RangeBias,
                why: "streets differ".into(),
                tell_by: "a wall".into(),
            }],
            considered: vec![],
            notes: vec!["a note <b>".into()],
        }
    }

    fn html(diagnosis: &Diagnosis) -> String {
        page_of(diagnosis, None, vec![])
    }

    fn page_of(diagnosis: &Diagnosis, view: Option<&View>, links: Vec<Link>) -> String {
        DiagnosisReport { diagnosis, view, links, title: "a against b".into(), command: "lidarshift".into() }
            .html()
            .unwrap()
    }

    #[test]
    fn a_page_has_findings_figures_and_what_was_not_found() {
        let std_m = Parameter { estimate: 0.02134, unit: Unit::Metre, ci95: [0.019, 0.0235] };
        let mut named = Finding { says: "ranges <scatter>".into(), reached: Some(0.83), ..loss_by_row() };
        (named.status, named.cause) = (Status::Named, Some(Cause::AngularJitter));
        named.parameters = [(Quantity::StdM.into(), std_m)].into();
        let page = html(&diagnosis(vec![named, loss_by_row()]));
        for words in [
            "2 differences were found: 1 with a named cause (angular_jitter), 1 that no cause of the catalogue explains.",
            "83 % of the difference is gone (70 to 90 %)",
            "ranges &#60;scatter&#62;",
            "std_m 0.0213 m (0.0190 to 0.0235)",
            "There is no table of it for any sensor of the rig.",
            "<svg",
            "<td class=\"n\">0.00310 m</td>",
            "a note &#60;b&#62;",
            "What these data cannot tell",
            "streets differ",
        ] {
            assert!(page.contains(words), "{words}\n{page}");
        }
        assert!(!page.contains("src=\"") && !page.contains("href=\"http"), "nothing is loaded");
    }

    #[test]
    fn a_page_has_one_frame_in_3d_behind_the_figures_and_links() {
        let d = diagnosis(vec![loss_by_row(), loss_by_row()]);
        let one = switch(Discrepancy::Range, &[Some(0.3), None]);
        let switches = vec![diagnose::Switch { finding: None, ..one.clone() }, one];
        let view = View { frame: "<7>".into(), points_m: vec![[1.0, 2.0, 3.0]; 2], switches };
        let link = Link { text: "The study <of detectors>".into(), href: "detectors/report.html".into() };
        let page = page_of(&d, Some(&view), vec![link]);
        let at = |words: &str| page.find(words).unwrap_or_else(|| panic!("{words}"));
        assert!(at("<h2>Each finding, before and after") < at("<h2>One frame in 3D"));
        assert!(at("<h2>One frame in 3D") < at("<h2>What was not found"));
        for words in [
            "The measured frame &#60;7&#62;: of the frames on which nothing was fitted",
            "Choose a finding and switch it off and on",
            "<label class=\"switch\"><input type=\"checkbox\" checked> applied to the simulation</label>",
            "which this browser does not offer; the figures above show every finding before and after.",
            "\"name\":\"All findings\"",
            "\"name\":\"1. unexplained\"",
            "<a href=\"detectors/report.html\">The study &#60;of detectors&#62;</a>",
        ] {
            at(words);
        }
        let one = View { switches: view.switches[1..].to_vec(), ..view };
        assert!(page_of(&d, Some(&one), vec![]).contains("off is the simulation as it is"));
        let without = html(&d);
        assert!(!without.contains("One frame in 3D") && !without.contains("class=\"viewer\""));
    }

    #[test]
    fn a_page_without_findings_says_so() {
        let page = html(&Diagnosis { gain: Gain::default(), ..diagnosis(vec![]) });
        assert!(page.contains("No difference between the measured and the simulated data is significant."));
        assert!(page.contains("What was not found") && !page.contains("What differs"));
    }
}
