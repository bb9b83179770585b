//! Classes of bucket-normalized EPE: groups of Argoverse 2 categories.
//!
//! Categories are numbered as in `flow_labels.feather`: 0 is no object, and 1 to 30 are the
//! categories of the data set in alphabetical order. The benchmark excludes signs, cones and
//! barrels because of inconsistent labels. Animals are in none of its classes.

use super::buckets::UNCLASSIFIED;

/// Names of the classes of bucket-normalized EPE, by class index: those of the benchmark, and
/// OBJECT for foreground of unknown class.
pub const CLASSES: [&str; 6] = [
    "BACKGROUND",
    "CAR",
    "OTHER_VEHICLES",
    "PEDESTRIAN",
    "WHEELED_VRU",
    "OBJECT",
];

/// Class of an Argoverse 2 category, as an index into [`CLASSES`].
///
/// Categories are numbered as in `flow_labels.feather`: 0 is no object, and 1 to 30 are the
/// categories in alphabetical order. Categories that the benchmark excludes, such as animals, signs
/// and cones, and unknown numbers are [`UNCLASSIFIED`].
pub fn class_of_category(category: u8) -> u8 {
    match category {
        0 => 0,
        // REGULAR_VEHICLE.
        19 => 1,
        // ARTICULATED_BUS, BOX_TRUCK, BUS, LARGE_VEHICLE, RAILED_VEHICLE, SCHOOL_BUS, TRUCK,
        // TRUCK_CAB, VEHICULAR_TRAILER.
        2 | 6 | 7 | 11 | 18 | 20 | 25 | 26 | 27 => 2,
        // OFFICIAL_SIGNALER, PEDESTRIAN, STROLLER, WHEELCHAIR.
        16 | 17 | 23 | 28 => 3,
        // BICYCLE, BICYCLIST, MOTORCYCLE, MOTORCYCLIST, WHEELED_DEVICE, WHEELED_RIDER.
        3 | 4 | 14 | 15 | 29 | 30 => 4,
        _ => UNCLASSIFIED,
    }
}

/// Class of a point that is only known to be foreground or background: OBJECT or BACKGROUND, as an
/// index into [`CLASSES`].
pub fn class_of_foreground(foreground: bool) -> u8 {
    if foreground { 5 } else { 0 }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Argoverse 2 categories in order, with the benchmark's class of each.
    const CATEGORIES: [(&str, Option<&str>); 31] = [
        ("NONE", Some("BACKGROUND")),
        ("ANIMAL", None),
        ("ARTICULATED_BUS", Some("OTHER_VEHICLES")),
        ("BICYCLE", Some("WHEELED_VRU")),
        ("BICYCLIST", Some("WHEELED_VRU")),
        ("BOLLARD", None),
        ("BOX_TRUCK", Some("OTHER_VEHICLES")),
        ("BUS", Some("OTHER_VEHICLES")),
        ("CONSTRUCTION_BARREL", None),
        ("CONSTRUCTION_CONE", None),
        ("DOG", None),
        ("LARGE_VEHICLE", Some("OTHER_VEHICLES")),
        ("MESSAGE_BOARD_TRAILER", None),
        ("MOBILE_PEDESTRIAN_CROSSING_SIGN", None),
        ("MOTORCYCLE", Some("WHEELED_VRU")),
        ("MOTORCYCLIST", Some("WHEELED_VRU")),
        ("OFFICIAL_SIGNALER", Some("PEDESTRIAN")),
        ("PEDESTRIAN", Some("PEDESTRIAN")),
        ("RAILED_VEHICLE", Some("OTHER_VEHICLES")),
        ("REGULAR_VEHICLE", Some("CAR")),
        ("SCHOOL_BUS", Some("OTHER_VEHICLES")),
        ("SIGN", None),
        ("STOP_SIGN", None),
        ("STROLLER", Some("PEDESTRIAN")),
        ("TRAFFIC_LIGHT_TRAILER", None),
        ("TRUCK", Some("OTHER_VEHICLES")),
        ("TRUCK_CAB", Some("OTHER_VEHICLES")),
        ("VEHICULAR_TRAILER", Some("OTHER_VEHICLES")),
        ("WHEELCHAIR", Some("PEDESTRIAN")),
        ("WHEELED_DEVICE", Some("WHEELED_VRU")),
        ("WHEELED_RIDER", Some("WHEELED_VRU")),
    ];

    #[test]
    fn every_category_is_of_the_class_that_the_benchmark_puts_it_in() {
        let names = CATEGORIES.iter().skip(1).map(|(name, _)| name);
        assert!(names.is_sorted());
        for (category, (name, class)) in (0..).zip(CATEGORIES) {
            let found = CLASSES.get(usize::from(class_of_category(category)));
            assert_eq!(found.copied(), class, "{name}");
        }
        assert_eq!(class_of_category(31), UNCLASSIFIED);
    }
}
