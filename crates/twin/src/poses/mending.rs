//! What is wrong with the frames of a recording and can be put right without a look at the clouds.

use super::findings::{PoseFinding, check_moments, in_order};
use data::Moment;
use data::layout::StampUnit;

/// The frames that are used.
#[derive(Clone, Debug, PartialEq)]
pub struct Found {
    /// The frames in the order of time.
    pub moments: Vec<Moment>,
    /// What was done, a sentence each.
    pub said: Vec<String>,
}

/// Puts frames in the order of their stamps (s), each stamp once, and leaves out those without a pose where others have
/// one. With `odometry` no pose is used: frames without one stay.
pub fn mend(mut moments: Vec<Moment>, odometry: bool) -> Found {
    let mut said = Vec::new();
    let findings = check_moments(&moments);
    let unit =
        findings.iter().find_map(|f| if let PoseFinding::StampUnit { unit, .. } = f { Some(*unit) } else { None });
    if let Some(unit) = unit.filter(|unit| *unit != StampUnit::Seconds) {
        let first = moments.iter().find_map(|m| m.stamp_s).unwrap_or(0.0);
        for stamp in moments.iter_mut().filter_map(|m| m.stamp_s.as_mut()) {
            *stamp = (*stamp - first) * unit.seconds();
        }
        said.extend(
            findings
                .iter()
                .filter(|f| matches!(f, PoseFinding::StampUnit { .. }))
                .map(|f| format!("{f}; they are converted")),
        );
    }
    let order = in_order(&moments);
    if order.windows(2).any(|w| w[0] > w[1]) || order.len() < moments.len() {
        let wrong = |f: &&PoseFinding| matches!(f, PoseFinding::OutOfOrder { .. } | PoseFinding::Twice { .. });
        let first = check_moments(&moments).iter().find(wrong).map(|f| format!(" ({f})")).unwrap_or_default();
        let again = moments.len() - order.len();
        said.push(format!(
            "frames are not in the order of their time stamps{first}: they are sorted, and {again} that have the time \
             stamp of another are left out"
        ));
        moments = order.iter().map(|i| moments[*i].clone()).collect();
    }
    let lacking = moments.iter().filter(|m| m.world_from_lidar.is_none()).count();
    if !odometry && lacking > 0 && lacking < moments.len() {
        let gaps = check_moments(&moments).into_iter().filter(|f| matches!(f, PoseFinding::NoPose { .. }));
        let gaps: Vec<String> = most_said(&gaps.collect::<Vec<_>>());
        said.push(format!("{}; they are left out; --odometry finds poses for all frames", gaps.join("; ")));
        moments.retain(|m| m.world_from_lidar.is_some());
    }
    Found { moments, said }
}

/// Findings of one kind that are said; of more the number is.
const MOST_SAID: usize = 2;

/// Findings as sentences. Of more than two of one kind only the first two stand, with the number of the others.
pub fn most_said(findings: &[PoseFinding]) -> Vec<String> {
    let mut kinds: Vec<(std::mem::Discriminant<PoseFinding>, Vec<String>)> = Vec::new();
    for finding in findings {
        let kind = std::mem::discriminant(finding);
        match kinds.iter_mut().find(|(known, _)| *known == kind) {
            Some((_, said)) => said.push(finding.to_string()),
            None => kinds.push((kind, vec![finding.to_string()])),
        }
    }
    let some = |(_, mut said): (_, Vec<String>)| {
        let more = said.len().saturating_sub(MOST_SAID);
        said.truncate(MOST_SAID);
        if let Some(last) = said.last_mut().filter(|_| more > 0) {
            last.push_str(&format!(" (and {more} more like it)"));
        }
        said
    };
    kinds.into_iter().flat_map(some).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use geometry::Pose;

    fn drive(frames: usize) -> Vec<Moment> {
        let moment = |i: usize| Moment {
            stamp_s: Some(0.1 * i as f64),
            world_from_lidar: Some(Pose::translation(i as f64, 0.0, 0.0)),
            ..Moment::of(&format!("{i:06}"))
        };
        (0..frames).map(moment).collect()
    }

    #[test]
    fn a_good_drive_stays_as_it_is() {
        assert_eq!(mend(drive(9), false), Found { moments: drive(9), said: vec![] });
    }

    #[test]
    fn order_units_and_gaps_are_put_right_and_said() {
        let mut moments = drive(9);
        moments.swap(3, 6);
        moments.push(moments[2].clone());
        moments[7].world_from_lidar = None;
        moments.iter_mut().for_each(|m| m.stamp_s = m.stamp_s.map(|s| 7e9 + 1e9 * s));
        let Found { moments, said } = mend(moments, false);
        let ids: Vec<&str> = moments.iter().map(|m| m.id.as_str()).collect();
        assert_eq!(ids, ["000000", "000001", "000002", "000003", "000004", "000005", "000006", "000008"]);
        assert!((moments[7].stamp_s.unwrap() - 0.8).abs() < 1e-6, "{:?}", moments[7]);
        assert!(said[0].contains("in ns; give them in s; they are converted"), "{said:?}");
        assert!(
            said[1].contains("they are sorted, and 1 that have the time stamp of another are left out"),
            "{said:?}"
        );
        assert!(said[2].contains("1 frames from 000007 to 000007 have no pose"), "{said:?}");
        assert_eq!(said.len(), 3);
    }

    #[test]
    fn the_odometry_needs_no_pose() {
        let mut moments = drive(9);
        moments[4].world_from_lidar = None;
        assert_eq!(mend(moments.clone(), true), Found { moments: moments.clone(), said: vec![] });
        moments.iter_mut().for_each(|m| m.world_from_lidar = None);
        assert_eq!(mend(moments.clone(), false), Found { moments, said: vec![] });
    }

    #[test]
    fn many_findings_of_one_kind_are_counted() {
        let findings: Vec<PoseFinding> = (0..9).map(|i| PoseFinding::NotFinite { frame: i.to_string() }).collect();
        let said = most_said(&findings);
        assert!(said.len() == 2 && said[1].ends_with("(and 7 more like it)"), "{said:?}");
    }
}
