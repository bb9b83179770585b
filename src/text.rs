//! Text for people: numbers, and text from outside.

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

/// Text from outside on one line: control characters, which would steer a terminal, and those that
/// turn the direction of the text around them, as escapes.
#[cfg(feature = "service")]
pub(crate) fn printable(text: &str) -> String {
    let mut out = String::with_capacity(text.len());
    for letter in text.chars() {
        match letter {
            '\n' | '\r' => out.push(' '),
            '\u{202a}'..='\u{202e}' | '\u{2066}'..='\u{2069}' => {
                out.extend(letter.escape_unicode());
            }
            letter if letter.is_control() => out.extend(letter.escape_default()),
            letter => out.push(letter),
        }
    }
    out
}

/// A URL without its user and password.
#[cfg(feature = "service")]
pub(crate) fn without_user(url: &str) -> String {
    let Some((scheme, rest)) = url.split_once("://") else {
        return url.to_owned();
    };
    let end = rest.find(['/', '?', '#']).unwrap_or(rest.len());
    match rest[..end].rfind('@') {
        None => url.to_owned(),
        Some(at) => format!("{scheme}://{}", &rest[at + 1..]),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[cfg(feature = "service")]
    #[test]
    fn text_from_outside_steers_no_terminal_and_shows_no_password() {
        assert_eq!(printable("a\x1b[31m\nb\u{9b}"), "a\\u{1b}[31m b\\u{9b}");
        assert_eq!(printable("a\u{202e}b\u{2069}é"), "a\\u{202e}b\\u{2069}é");
        assert_eq!(without_user("https://u:p@h/a@b"), "https://h/a@b");
        assert_eq!(without_user("s3://bucket/a@b"), "s3://bucket/a@b");
        assert_eq!(without_user("u:p@h"), "u:p@h");
    }

    #[test]
    fn digits_are_grouped_by_three() {
        let numbers = [0, 12, 999, 1000, 81_856, 1_234_567].map(grouped);
        assert_eq!(numbers, ["0", "12", "999", "1,000", "81,856", "1,234,567"]);
    }
}
