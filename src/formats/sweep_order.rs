//! The order of sweeps by the numbers in their file names.

use core::cmp::Ordering;

/// The text of a file name between its runs of digits, and the runs without leading zeros.
fn parts(name: &str) -> (Vec<&str>, Vec<&str>) {
    let file = name.rsplit(['/', '\\']).next().unwrap_or(name);
    let is_digit = |letter: char| letter.is_ascii_digit();
    let texts = file.split(is_digit).filter(|text| !text.is_empty());
    let runs = file.split(|letter| !is_digit(letter));
    let numbers = runs.filter(|digits| !digits.is_empty());
    let plain = numbers.map(|digits| digits.trim_start_matches('0'));
    (texts.collect(), plain.collect())
}

/// Compares two numbers without leading zeros.
fn compared(a: &str, b: &str) -> Ordering {
    a.len().cmp(&b.len()).then_with(|| a.cmp(b))
}

/// Compares two file names by the text around their numbers, then by the numbers, so that `2.pcd` comes
/// before `10.pcd`, then as text. It is a total order of names of all kinds.
pub fn compare_names(one: &str, other: &str) -> Ordering {
    let (texts, numbers) = parts(one);
    let (other_texts, other_numbers) = parts(other);
    let pairs = numbers.iter().zip(&other_numbers);
    let steps = pairs.map(|(a, b)| compared(a, b));
    texts
        .cmp(&other_texts)
        .then(numbers.len().cmp(&other_numbers.len()))
        .then_with(|| steps.fold(Ordering::Equal, Ordering::then))
        .then_with(|| one.cmp(other))
}

/// Whether two names differ in their numbers alone.
fn is_comparable(one: &str, other: &str) -> bool {
    let [one, other] = [one, other].map(parts);
    one.0 == other.0 && one.1.len() == other.1.len()
}

/// The order of the sweeps of a sequence by the numbers of their file names, name by name. It begins anew
/// where two names differ in more than their numbers.
#[derive(Clone, Debug, Default)]
pub struct SweepOrder {
    last: Option<String>,
    /// How the numbers go on, once two names have shown it.
    direction: Option<Ordering>,
}

impl SweepOrder {
    /// Adds the name of the next sweep. Returns the name before it where the numbers turn back there.
    pub fn push(&mut self, name: &str) -> Option<String> {
        let last = self.last.replace(name.to_owned())?;
        if !is_comparable(&last, name) {
            self.direction = None;
            return None;
        }
        let [(_, before), (_, after)] = [&last, name].map(|name| parts(name));
        let steps = before.iter().zip(&after).map(|(a, b)| compared(a, b));
        let step = steps.fold(Ordering::Equal, Ordering::then);
        if step == Ordering::Equal {
            return None;
        }
        let direction = *self.direction.get_or_insert(step);
        (step != direction).then_some(last)
    }
}

/// The index of the first sweep after which the numbers of the file names go the other way, see
/// [`SweepOrder`]. None if they rise or fall throughout.
///
/// ```
/// use fnsf::formats::turning_sweep;
/// assert_eq!(turning_sweep(&["1.pcd", "10.pcd", "2.pcd"]), Some(1));
/// assert_eq!(turning_sweep(&["1.pcd", "2.pcd", "10.pcd"]), None);
/// ```
pub fn turning_sweep(names: &[&str]) -> Option<usize> {
    let mut order = SweepOrder::default();
    let after = names.iter().position(|name| order.push(name).is_some())?;
    Some(after - 1)
}

#[cfg(test)]
mod tests {
    use super::{compare_names, turning_sweep};

    #[test]
    fn names_of_several_kinds_have_one_order() {
        // As text `9.b` comes before `9.bin`, by number `9.bin` before `10.bin`.
        let names = ["9.bin", "10.bin", "9.b", "x9.bin", "9", "09.bin"];
        for one in names {
            for other in names {
                let order = compare_names(one, other);
                assert_eq!(order, compare_names(other, one).reverse());
                for third in names {
                    if order.is_le() && compare_names(other, third).is_le() {
                        assert!(compare_names(one, third).is_le(), "{one} {other} {third}");
                    }
                }
            }
        }
    }

    #[test]
    fn numbers_that_turn_back_are_found_and_others_are_left_alone() {
        for (names, turn) in [
            (&["1.pcd", "10.pcd", "11.pcd", "2.pcd"][..], Some(2)),
            (&["a/3.pcd", "a/2.pcd", "a/1.pcd"], None),
            (&["3.pcd", "2.pcd", "5.pcd"], Some(1)),
            (&["s_08.bin", "s_09.bin", "s_10.bin"], None),
            (&["drive2_1.ply", "drive2_2.ply", "drive1_3.ply"], Some(1)),
            (&["1.pcd", "1.pcd", "2.pcd"], None),
            (&["source.ply", "target.ply"], None),
            (&["before.ply", "after.ply", "b4.ply"], None),
            (&["a_1.ply", "a_2.ply", "b_1.ply", "b_2.ply"], None),
            (&["map.ply", "1.ply", "10.ply", "2.ply"], Some(2)),
            (&["1.ply", "2.ply", "2.ply", "1.ply"], Some(2)),
            (
                &["9.bin", "1532402927647951.bin", "1532402927697731.bin"],
                None,
            ),
            (
                &[
                    "9.pcd",
                    "99999999999999999999998.pcd",
                    "100000000000000000000000.pcd",
                ],
                None,
            ),
            (&["only.ply"], None),
            (&[], None),
        ] {
            assert_eq!(turning_sweep(names), turn, "{names:?}");
        }
    }
}
