//! Formatting of numbers for people.

/// Formats `1234567` as `1,234,567`.
pub(crate) fn grouped(number: usize) -> String {
    let digits = number.to_string();
    let mut out = String::new();
    for (place, digit) in digits.chars().enumerate() {
        if place > 0 && (digits.len() - place).is_multiple_of(3) {
            out.push(',');
        }
        out.push(digit);
    }
    out
}

#[cfg(test)]
mod tests {
    use super::grouped;

    #[test]
    fn digits_are_grouped_by_three() {
        let numbers = [0, 12, 999, 1000, 81_856, 1_234_567].map(grouped);
        assert_eq!(numbers, ["0", "12", "999", "1,000", "81,856", "1,234,567"]);
    }
}
