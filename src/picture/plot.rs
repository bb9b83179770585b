//! Plots as SVG: points with names on axes, linear or logarithmic.

use std::fmt::Write as _;

/// Width and height, pixels.
const SIZE: [f64; 2] = [720.0, 480.0];
/// Free space left, right, above and below the axes, pixels.
const LEFT: f64 = 70.0;
const RIGHT: f64 = 30.0;
const TOP: f64 = 40.0;
const BOTTOM: f64 = 55.0;
/// Share of the range that is left free at both ends of an axis.
const MARGIN: f64 = 0.06;

/// An axis: its title with the unit, and whether it is logarithmic.
#[derive(Clone, Copy, Debug)]
pub struct Axis<'a> {
    /// The title, with the unit.
    pub title: &'a str,
    /// Whether the axis is logarithmic. Values must then be above zero.
    pub is_logarithmic: bool,
}

/// Points of one color, each with a name; joined by a line or not.
#[derive(Clone, Debug)]
pub struct Series {
    /// The name in the legend; empty for none.
    pub name: String,
    /// The points: x, y and the name beside the point, which may be empty.
    pub points: Vec<(f64, f64, String)>,
    /// Whether the points are joined by a line.
    pub is_joined: bool,
}

/// A plot of series on two axes.
#[derive(Clone, Debug)]
pub struct Plot<'a> {
    /// The title above the plot.
    pub title: &'a str,
    /// The axes x and y.
    pub axes: [Axis<'a>; 2],
    /// The series, in colors of their own.
    pub series: Vec<Series>,
}

/// Colors that also differ for color-blind readers (Okabe and Ito).
const COLORS: [&str; 7] = [
    "#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000",
];

/// The range of an axis, and its mapping to pixels.
struct Scale {
    is_logarithmic: bool,
    low: f64,
    high: f64,
    /// Pixels of `low` and of `high`.
    pixels: [f64; 2],
}

impl Scale {
    fn new(values: impl Iterator<Item = f64>, is_logarithmic: bool, pixels: [f64; 2]) -> Self {
        let shown = |value: f64| if is_logarithmic { value.log10() } else { value };
        let values = values.map(shown).filter(|value| value.is_finite());
        let (low, high) = values.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), value| {
            (low.min(value), high.max(value))
        });
        let (low, high) = if low > high { (0.0, 1.0) } else { (low, high) };
        let low = if is_logarithmic { low } else { low.min(0.0) };
        let free = ((high - low) * MARGIN).max(1e-3);
        Self {
            is_logarithmic,
            low: if is_logarithmic { low - free } else { low },
            high: high + free,
            pixels,
        }
    }

    /// The pixel of a value.
    fn at(&self, value: f64) -> f64 {
        let shown = if self.is_logarithmic {
            value.log10()
        } else {
            value
        };
        let share = (shown - self.low) / (self.high - self.low);
        self.pixels[0] + share * (self.pixels[1] - self.pixels[0])
    }

    /// The values with a tick: 1, 2 and 5 times powers of ten.
    fn ticks(&self) -> Vec<f64> {
        if self.is_logarithmic {
            let decades = self.low.floor() as i32..=self.high.ceil() as i32;
            let values = decades
                .flat_map(|decade| [1.0, 2.0, 5.0].map(|factor| factor * 10f64.powi(decade)));
            let within = |value: &f64| (self.low..=self.high).contains(&value.log10());
            return values.filter(within).collect();
        }
        let rough = (self.high - self.low) / 6.0;
        let decade = 10f64.powf(rough.log10().floor());
        let factors = [1.0, 2.0, 5.0, 10.0].into_iter();
        let mut steps = factors.map(|factor| factor * decade);
        let step = steps.find(|&step| step >= rough).unwrap_or(decade);
        let first = (self.low / step).ceil() as i64;
        let last = (self.high / step).floor() as i64;
        (first..=last).map(|number| number as f64 * step).collect()
    }
}

/// The place of a text: its baseline's point and the side that is there.
struct Place {
    at: [f64; 2],
    anchor: &'static str,
}

/// The names beside points that are placed already.
struct Names {
    /// Pixels between which names fit.
    within: [f64; 2],
    /// Left, top, right and bottom of each.
    taken: Vec<[f64; 4]>,
}

impl Names {
    /// A place beside a point for a name of so many letters: the first of six that lies within the
    /// axes and on no other name, else the first.
    fn place(&mut self, [x, y]: [f64; 2], letters: usize) -> Place {
        const LETTER: f64 = 6.6;
        const HEIGHT: f64 = 12.0;
        let width = letters as f64 * LETTER;
        let sides = [
            (8.0, -5.0, "start"),
            (8.0, 14.0, "start"),
            (-8.0, -5.0, "end"),
            (-8.0, 14.0, "end"),
            (0.0, -10.0, "middle"),
            (0.0, 20.0, "middle"),
        ];
        let boxed = |(right, down, anchor): (f64, f64, &str)| {
            let begin = match anchor {
                "start" => x + right,
                "end" => x + right - width,
                _ => x - width / 2.0,
            };
            [begin, y + down - HEIGHT, begin + width, y + down]
        };
        let is_free = |&side: &(f64, f64, &str)| {
            let [left, top, right, bottom] = boxed(side);
            let apart = |other: &[f64; 4]| {
                right < other[0] || other[2] < left || bottom < other[1] || other[3] < top
            };
            left >= self.within[0] && right <= self.within[1] && self.taken.iter().all(apart)
        };
        let side = sides.into_iter().find(is_free).unwrap_or(sides[0]);
        self.taken.push(boxed(side));
        Place {
            at: [x + side.0, y + side.1],
            anchor: side.2,
        }
    }
}

/// The text without the characters that have a meaning in SVG.
fn escaped(text: &str) -> String {
    text.replace('&', "&amp;")
        .replace('<', "&lt;")
        .replace('>', "&gt;")
        .replace('"', "&quot;")
}

/// The shortest digits of a tick.
fn label(value: f64) -> String {
    let rounded = format!("{value:.6}");
    let short = rounded.trim_end_matches('0').trim_end_matches('.');
    short.to_owned()
}

impl Plot<'_> {
    /// The plot as an SVG document. Points that are not finite, or not above zero on a logarithmic
    /// axis, are left out.
    pub fn to_svg(&self) -> String {
        let [width, height] = SIZE;
        let drawable = |&&(x, y, _): &&(f64, f64, String)| {
            let fits = |value: f64, axis: &Axis<'_>| {
                value.is_finite() && (value > 0.0 || !axis.is_logarithmic)
            };
            fits(x, &self.axes[0]) && fits(y, &self.axes[1])
        };
        let points = || self.series.iter().flat_map(|series| &series.points);
        let of = |axis: usize, pixels: [f64; 2]| {
            let values = points().filter(drawable);
            let values = values.map(|&(x, y, _)| if axis == 0 { x } else { y });
            Scale::new(values, self.axes[axis].is_logarithmic, pixels)
        };
        let across = of(0, [LEFT, width - RIGHT]);
        let up = of(1, [height - BOTTOM, TOP]);
        let mut svg = String::new();
        // Writing to a string does not fail.
        let mut put = |line: std::fmt::Arguments<'_>| {
            let _ = writeln!(svg, "{line}");
        };
        put(format_args!(
            "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {width} {height}\" \
             font-family=\"sans-serif\" font-size=\"12\">"
        ));
        put(format_args!(
            "<rect width=\"{width}\" height=\"{height}\" fill=\"white\"/>"
        ));
        put(format_args!(
            "<text x=\"{LEFT}\" y=\"22\" font-size=\"15\">{}</text>",
            escaped(self.title)
        ));
        let [bottom, top] = up.pixels;
        let [left, right] = across.pixels;
        for tick in across.ticks() {
            let x = across.at(tick);
            put(format_args!(
                "<path d=\"M{x:.1} {bottom}V{top}\" stroke=\"#ddd\"/>\
                 <text x=\"{x:.1}\" y=\"{:.1}\" text-anchor=\"middle\">{}</text>",
                bottom + 16.0,
                label(tick)
            ));
        }
        for tick in up.ticks() {
            let y = up.at(tick);
            put(format_args!(
                "<path d=\"M{left} {y:.1}H{right}\" stroke=\"#ddd\"/>\
                 <text x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"end\">{}</text>",
                left - 6.0,
                y + 4.0,
                label(tick)
            ));
        }
        put(format_args!(
            "<path d=\"M{left} {top}V{bottom}H{right}\" fill=\"none\" stroke=\"#444\"/>"
        ));
        put(format_args!(
            "<text x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"middle\">{}</text>",
            (left + right) / 2.0,
            height - 14.0,
            escaped(self.axes[0].title)
        ));
        let middle = (top + bottom) / 2.0;
        put(format_args!(
            "<text x=\"18\" y=\"{middle:.1}\" text-anchor=\"middle\" \
             transform=\"rotate(-90 18 {middle:.1})\">{}</text>",
            escaped(self.axes[1].title)
        ));
        let mut names = Names {
            within: [left, right],
            taken: Vec::new(),
        };
        for (number, series) in self.series.iter().enumerate() {
            let color = COLORS[number % COLORS.len()];
            let places: Vec<_> = series
                .points
                .iter()
                .filter(drawable)
                .map(|(x, y, name)| (across.at(*x), up.at(*y), name))
                .collect();
            if series.is_joined {
                let line = places.iter().map(|(x, y, _)| format!("{x:.1},{y:.1}"));
                let line = line.collect::<Vec<_>>().join(" ");
                put(format_args!(
                    "<polyline points=\"{line}\" fill=\"none\" stroke=\"{color}\" stroke-width=\"2\"/>"
                ));
            }
            for (x, y, name) in places {
                put(format_args!(
                    "<circle cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"4\" fill=\"{color}\"/>"
                ));
                if name.is_empty() {
                    continue;
                }
                let Place { at, anchor } = names.place([x, y], name.chars().count());
                put(format_args!(
                    "<text x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"{anchor}\" fill=\"{color}\">{}</text>",
                    at[0],
                    at[1],
                    escaped(name)
                ));
            }
            if !series.name.is_empty() {
                put(format_args!(
                    "<text x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"end\" fill=\"{color}\">{}</text>",
                    right - 4.0,
                    top + 14.0 + 16.0 * number as f64,
                    escaped(&series.name)
                ));
            }
        }
        put(format_args!("</svg>"));
        svg
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn plot(points: Vec<(f64, f64, String)>) -> String {
        Plot {
            title: "a < b & c",
            axes: [
                Axis {
                    title: "time, s",
                    is_logarithmic: true,
                },
                Axis {
                    title: "error, m",
                    is_logarithmic: false,
                },
            ],
            series: vec![Series {
                name: "one".to_owned(),
                points,
                is_joined: true,
            }],
        }
        .to_svg()
    }

    #[test]
    fn every_point_lies_within_the_axes_and_names_are_escaped() {
        let points = [(0.1, 0.05), (10.0, 0.2), (200.0, 0.0)];
        let points = points.map(|(x, y)| (x, y, "<name>".to_owned()));
        let svg = plot(points.to_vec());
        assert!(svg.contains("a &lt; b &amp; c") && !svg.contains("<name>"));
        let circles: Vec<_> = svg.match_indices("<circle").collect();
        assert_eq!(circles.len(), 3);
        for (at, _) in circles {
            let value = |name: &str| -> f64 {
                let from = svg[at..].find(name).expect("there") + at + name.len();
                let to = svg[from..].find('"').expect("its end") + from;
                svg[from..to].parse().expect("a number")
            };
            assert!((LEFT..=SIZE[0] - RIGHT).contains(&value("cx=\"")));
            assert!((TOP..=SIZE[1] - BOTTOM).contains(&value("cy=\"")));
        }
    }

    #[test]
    fn points_that_cannot_be_drawn_are_left_out() {
        let points = [(0.0, 0.1), (f64::NAN, 0.1), (1.0, f64::INFINITY)];
        let points = points.map(|(x, y)| (x, y, String::new()));
        let svg = plot(points.to_vec());
        assert!(!svg.contains("<circle") && !svg.contains("NaN") && !svg.contains("inf"));
    }
}
