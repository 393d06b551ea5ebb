//! Time stamps as text: seconds, whole numbers of smaller units, or date and time.

use crate::DataError;
use crate::limits::{MOST_IDS, at_most};
use std::path::Path;

/// Unit of time stamps.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum StampUnit {
    /// s
    Seconds,
    /// ms
    Milliseconds,
    /// us
    Microseconds,
    /// ns
    Nanoseconds,
}

impl StampUnit {
    /// All units, the longest first.
    pub const ALL: [StampUnit; 4] =
        [StampUnit::Seconds, StampUnit::Milliseconds, StampUnit::Microseconds, StampUnit::Nanoseconds];

    /// Length of the unit, s.
    pub fn seconds(self) -> f64 {
        match self {
            StampUnit::Seconds => 1.0,
            StampUnit::Milliseconds => 1e-3,
            StampUnit::Microseconds => 1e-6,
            StampUnit::Nanoseconds => 1e-9,
        }
    }

    /// The unit in which frames are from 5 ms to 5 s apart. `step` is the median step between stamps.
    ///
    /// `None` if there is none, such as for a step of zero.
    pub fn of_step(step: f64) -> Option<StampUnit> {
        StampUnit::ALL.into_iter().find(|unit| (0.005..5.0).contains(&(step * unit.seconds())))
    }
}

/// Parses stamps, s since the first: the first column of each line. The unit follows from the steps, see
/// [`StampUnit::of_step`]. `path` is used in error messages.
///
/// # Errors
/// A line that is no number and no date with a time, and steps that fit no unit.
pub(super) fn parse_stamps(text: &str, path: &Path) -> Result<Vec<f64>, DataError> {
    let mut stamps = Vec::new();
    let mut first = None;
    for (i, line) in text.trim_end().lines().enumerate() {
        at_most(path, "time stamps", i as u64 + 1, MOST_IDS)?;
        let stamp = parse_stamp(line).map_err(|message| DataError::line(path, i + 1, message))?;
        stamps.push(stamp.since(*first.get_or_insert(stamp)));
    }
    if stamps.is_empty() {
        return Err(DataError::file(path, "has no time stamp"));
    }
    let steps: Vec<f64> = stamps.windows(2).map(|pair| (pair[1] - pair[0]).abs()).collect();
    let Some(step) = statistics::median_upper(steps) else { return Ok(stamps) };
    let unit = StampUnit::of_step(step).ok_or_else(|| {
        let message = format!("the median step between time stamps is {step}: no unit from s to ns makes it a scan's");
        DataError::file(path, message)
    })?;
    Ok(stamps.into_iter().map(|stamp| stamp * unit.seconds()).collect())
}

/// A stamp whose whole part is exact: nanoseconds since 1970 have more digits than f64.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Stamp {
    whole: i64,
    fraction: f64,
}

impl Stamp {
    fn since(self, first: Stamp) -> f64 {
        self.whole.wrapping_sub(first.whole) as f64 + (self.fraction - first.fraction)
    }
}

fn parse_stamp(line: &str) -> Result<Stamp, String> {
    let wrong = || format!("{line:?} begins with neither a number nor a date and time like 2011-09-26 13:02:25.951");
    let mut words = line.split(|c: char| c.is_ascii_whitespace() || c == ',' || c == 'T').filter(|w| !w.is_empty());
    let word = words.next().ok_or_else(wrong)?;
    if word.matches('-').count() == 2 && !word.starts_with('-') {
        return date_and_time(word, words.next().ok_or_else(wrong)?).ok_or_else(wrong);
    }
    if let Ok(whole) = word.parse::<i64>() {
        return Ok(Stamp { whole, fraction: 0.0 });
    }
    let value = word.parse::<f64>().ok().filter(|v| v.abs() < 9e18).ok_or_else(wrong)?;
    let (whole, fraction) = (value.floor() as i64, value - value.floor());
    // Digits after the point of a long decimal, which f64 would round.
    let digits = word.split_once('.').filter(|_| whole > 0 && !word.contains(['e', 'E']));
    let digits = digits.and_then(|(_, digits)| format!("0.{digits}").parse().ok());
    Ok(Stamp { whole, fraction: digits.unwrap_or(fraction) })
}

/// Seconds since 1970 of `2011-09-26` and `13:02:25.951199337`.
fn date_and_time(date: &str, time: &str) -> Option<Stamp> {
    let mut numbers = date.splitn(3, '-').map(|n| n.parse::<i64>().ok());
    let (year, month, day) = (numbers.next()??, numbers.next()??, numbers.next()??);
    let mut parts = time.trim_end_matches('Z').splitn(3, ':');
    let (hour, minute) = (parts.next()?.parse::<i64>().ok()?, parts.next()?.parse::<i64>().ok()?);
    let second = parts.next()?.parse::<f64>().ok()?;
    let valid = (1..=9999).contains(&year) && (1..=12).contains(&month) && (1..=31).contains(&day);
    if !valid || !(0..24).contains(&hour) || !(0..60).contains(&minute) || !(0.0..61.0).contains(&second) {
        return None;
    }
    // Days of the proleptic Gregorian calendar, counted in years that begin in March.
    let (year, month) = if month > 2 { (year, month - 3) } else { (year - 1, month + 9) };
    let days = 365 * year + year / 4 - year / 100 + year / 400 + (153 * month + 2) / 5 + day - 1 - 719_468;
    let whole = days * 86_400 + hour * 3600 + minute * 60 + second.floor() as i64;
    Some(Stamp { whole, fraction: second - second.floor() })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parse(text: &str) -> Result<Vec<f64>, String> {
        parse_stamps(text, Path::new("times.txt")).map_err(|e| e.to_string())
    }

    #[test]
    fn all_units_give_seconds_since_the_first() {
        let cases = [
            "0.0\n0.1\n0.25\n",
            "1317042145.000 49.0 8.4\n1317042145.100 49.0 8.4\n1317042145.250\n",
            "1e0\n11e-1\n1.25\n",
            "1317042145000\n1317042145100\n1317042145250",
            "1532402927647951\n1532402927747951\n1532402927897951\n",
            "315966265259836000\n315966265359836000\n315966265509836000\n",
            "2011-09-26 23:59:59.900000000\n2011-09-27 00:00:00.000000000\n2011-09-27 00:00:00.150000000\n",
            "2012-02-28T23:59:59.900Z\n2012-02-29T00:00:00.0Z\n2012-02-29T00:00:00.15Z\n",
        ];
        for text in cases {
            let stamps = parse(text).unwrap();
            for (got, want) in stamps.iter().zip([0.0, 0.1, 0.25]) {
                assert!((got - want).abs() < 1e-9, "{text}: {stamps:?}");
            }
            assert_eq!(stamps.len(), 3);
        }
        let stamp = date_and_time("2011-09-26", "13:02:25.5").unwrap();
        assert_eq!(stamp, Stamp { whole: 1_317_042_145, fraction: 0.5 });
        assert_eq!(parse("7\n").unwrap(), [0.0]);
    }

    #[test]
    fn bad_stamps_are_refused_by_line() {
        for (line, want) in [
            ("soon", "times.txt:2: \"soon\" begins with neither"),
            ("", "times.txt:2: "),
            ("2011-13-01 00:00:00", "times.txt:2: "),
            ("2011-12-01", "times.txt:2: "),
            ("nan", "times.txt:2: "),
            ("0.0", "the median step between time stamps is 0"),
        ] {
            let error = parse(&format!("0.0\n{line}\n0.0\n")).unwrap_err();
            assert!(error.contains(want), "{error}");
        }
        assert_eq!(parse("\n").unwrap_err(), "times.txt: has no time stamp");
    }

    #[test]
    fn the_unit_of_a_step() {
        for (step, want) in [
            (0.1, Some(StampUnit::Seconds)),
            (0.5, Some(StampUnit::Seconds)),
            (50.0, Some(StampUnit::Milliseconds)),
            (1e5, Some(StampUnit::Microseconds)),
            (1e8, Some(StampUnit::Nanoseconds)),
            (0.0, None),
            (f64::NAN, None),
        ] {
            assert_eq!(StampUnit::of_step(step), want, "{step}");
        }
    }
}
