"""What each number of clip_evidence says, and its range (RA-17).

"Against the reference" is a ratio to, or a difference from, the reference frame: about 1 or 0 where nothing is wrong.
Shares lie in [0, 1]; levels are grey levels of 0 to 255; sizes are object sizes, the square root of the object's area
in the reference frame, and end at 20; steps are from one frame to the next. First and last are frames of the clip;
in uncovered ones no robot is within 0.15 sizes of the object, its lowest point is its tool. What readers answer
(sequence.reading_names) comes on top: log-odds, without limits.
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class Definition:
    """low, high: no clip gives a number outside of them. text: what it is."""

    low: float
    high: float
    text: str


INF = float("inf")
_TABLE = """
sharpness_mean        0 inf  fine over coarser detail against the reference, mean over time
sharpness_min         0 inf  the same, least sharp frame
sharpness_first       0 inf  the same, first frame
detail_mean           0 inf  fine detail |x - 3 x 3 mean| against the reference, mean over time
detail_first          0 inf  the same, first frame
detail_spread         0 inf  the same, standard deviation over time
tile_detail_low       0 inf  15 % quantile over 6 x 6 tiles of the median over time of detail against the reference
tile_detail_lost      0 1    share of tiles and frames with less than 0.45 of the reference's detail
gain_mean             0 inf  brightness against the reference, median over cells, mean over time
gain_min              0 inf  the same, darkest frame
gain_max              0 inf  the same, brightest frame
gain_step             0 inf  largest step of that brightness
flicker               0 inf  mean absolute second difference of that brightness
flicker_max           0 inf  its largest value
light_contrast        0 inf  standard deviation of brightness over cells against the reference
black_more           -1 1    share of cells darker than 10 levels, less the reference's
darkened_mean         0 1    share of cells with less than half of the brightness that the frame's gain explains
darkened_start        0 1    the same, first frame
darkened_low          0 inf  2 % quantile over cells and frames of brightness against the reference
hue_first             0 180  turn of all hues against the reference, degrees, first frame
hue_last              0 180  the same, last frame
hue_max               0 180  the same, largest
hue_drift             0 360  turn of hues from first to last frame, degrees
chroma_kept           0 inf  chroma shared with the reference, over its power, mean over time
chroma_kept_min       0 inf  the same, least
saturation            0 inf  power of chroma against the reference
cast_first            0 510  length of the median change of chroma against the reference, levels, first frame
cast_last             0 510  the same, last frame
cast_step             0 510  its largest step
reference_first       0 255  mean absolute difference of cells from the reference, levels, first frame
reference_median      0 255  median over cells of that difference, mean over time
reference_median_first 0 255 the same, first frame
changed_first         0 1    share of cells that differ from the reference by more than 10 levels, first frame
tiles_changed_low     0 255  25 % quantile over tiles of the last frame's difference from the reference, levels
tile_changed_most     0 255  largest difference from the reference of a tile in any frame, levels
picture_steps         0 255  median over cells of the step, mean over time, levels
static_share          0 1    share of cells that stay within 10 levels of the first frame all through
static_away           0 255  difference of those cells in the last frame from the reference, levels
motion_mean           0 255  mean absolute step of 24 x 24 cells, levels
motion_still          0 1    share of steps below 0.15 levels
motion_still_start    0 1    share of the clip before the first larger step
motion_still_end      0 1    share of the clip after the last one
motion_still_within   0 1    share of still steps between them
motion_switches       0 1    changes between still and moving, over steps
motion_jump           0 inf  largest step over the median moving one
motion_jump_share     0 1    largest step over the sum of all
motion_centre         0 1    time about which the motion is centred
motion_net            0 255  difference of last from first frame, levels
motion_directness     0 1    that over the sum of all steps
motion_bend           0 inf  mean absolute second difference over mean step
order_wrong           0 1    share of moving frames whose next but one is nearer than their next
order_again           0 1    share of frames that equal an earlier one after something else was shown
order_again_run       0 1    longest run of such frames in motion
order_gap             0 inf  largest distance of a frame to its nearest other one, over the median moving step
order_jump            0 inf  largest step over the distance to the nearest other frame
order_detour          0 inf  length of the clip over that of the shortest tree that joins its frames
object_seen           0 1    share of frames that show at least a fifth of the object's reference area
object_seen_last      0 inf  its area against the reference, mean of the last three frames
object_area_first     0 inf  its area against the reference, first frame
object_area_free      0 inf  the same, median over frames in which no robot is near it
object_area_max       0 inf  the same, largest of all frames
object_area_low       0 inf  the same, smallest of the free frames
object_area_last      0 inf  the same, last free frame
object_area_step      0 inf  largest step of it between free frames
object_height_max     0 inf  height of its box against the reference, largest of the free frames
object_height_min     0 inf  the same, smallest
object_height_last    0 inf  the same, last
object_width_max      0 inf  width of its box against the reference, largest of the free frames
object_width_min      0 inf  the same, smallest
object_width_last     0 inf  the same, last
object_aspect         0 inf  height over width against the reference, mean of the free frames
object_second         0 1    share of frames with a second object of at least a quarter of its reference area
object_second_max     0 inf  area of the second object against the reference, largest
object_second_last    0 inf  the same, mean of the last three frames
tall_max              0 inf  height of its box against the reference, largest of all frames that show it
tall_end              0 inf  the same, mean of the last three of them
wide_max              0 inf  width of its box against the reference, largest of all frames that show it
wide_end              0 inf  the same, mean of the last three of them
long_max              0 inf  its longer over its shorter extent against the reference, largest
long_end              0 inf  the same, mean of the last three frames that show it
thin_end              0 inf  its shorter extent against the reference, mean of these three
reshaped_height       0 inf  largest |log ratio| of heights three frames apart, free and in place
reshaped_width        0 inf  the same of widths
reshaped_area         0 inf  the same of areas
object_lost           0 1    share of frames without the object
object_lost_open      0 1    the same, with hardly any robot where it was last
place_covered_max     0 1    share of the object's reference pixels that the robot covers, largest
place_held_last       0 1    share of them that show the object in the last frame
place_empty_last      0 1    share of them that show neither in the last frame
touch_area            0 inf  its visible area against the reference while the robot touches it, mean
touch_area_min        0 inf  the same, smallest
touch_inside          0 1    share of its box that is robot while it is touched, mean
touch_inside_max      0 1    the same, largest
object_path           0 20   length of its path, sizes
object_net            0 20   distance of its last place from the reference's, sizes
object_step           0 20   its largest step, sizes
object_steps_moving   0 1    share of steps of more than 0.12 sizes
object_step_share     0 1    largest step over the path
object_first_away     0 20   distance of its first place from the reference's, sizes
object_raised         0 20   how far it gets above its reference place in the picture, sizes
object_rise           0 20   how far it rises in the picture within three steps, most, sizes
object_rise_late      0 20   the same in the later half
object_reappeared     0 20   largest way that it went while unseen, sizes
gap_min               0 20   smallest distance from robot to object, sizes
gap_last              0 20   the same, last frame
gap_onset             0 20   the same where the object first moves
gap_moving_max        0 20   the same, largest while it moves
gap_moving_mean       0 20   the same, mean while it moves
moved_apart           0 20   length of its path with no robot within 0.3 sizes
moved_apart_step      0 20   the largest step of that
touched_share         0 1    share of frames with the robot within 0.3 sizes
touch_first           0 1    when that first happens; 1 never
onset                 0 1    when the object first moves; 1 never
touch_after_onset    -1 1    by how much the touch is later than the motion, share of the clip
after_touch_side      0 20   how far it goes sideways after the last touch, sizes
after_touch_rise      0 20   how far it rises in the picture after the last touch, sizes
tool_path             0 20   length of the path of the robot's lowest point, sizes
tool_net              0 20   distance between its ends, sizes
tool_passed         -20 20   how far it gets beyond the object along its own way, sizes
slipped             -20 20   way of the robot less the object's while they touch, sizes
tool_near_min         0 20   smallest distance of the lowest point from the object, sizes
jump_alone          -20 20   by how much its step is longer than the lowest point's, most, sizes
jump_alone_seen       0 20   the same of steps between frames that show half of its reference area
jump_sudden         -20 20   by how much a step is longer than those before and after it, most, sizes
jump_sudden_tool      0 20   step of the lowest point at that time, sizes
jump_sudden_gap       0 20   distance of robot and object at that time, sizes
jump_sudden_seen      0 20   area of the object against the reference at that time
jump_sudden_when      0 1    when that is
jump_sudden_along   -20 20   its step along that of the lowest point at that time, sizes
jump_sudden_pulled  -20 20   its step towards the lowest point at that time, sizes
jump_sudden_closing -20 20   step of the lowest point towards it at that time, sizes
jump_unhit          -20 20   by how much its step is longer than twice that of the lowest point towards it, most, sizes
jump_unhit_seen       0 20   the same of steps between frames that show half of its reference area
jump_against        -20 20   its step against the direction of the lowest point, most, sizes
jump_side             0 20   its step across that direction, most, sizes
pulled_step         -20 20   its step towards the lowest point, most, sizes
pulled_sum            0 20   sum of such steps with the robot within a size
still_moved           0 20   its path while the lowest point stands still, sizes
still_jump            0 20   its largest step of that
rest_jump             0 20   its largest step after two steps of rest, sizes
rest_jump_gap         0 20   the same times the distance to the robot, at most 2 sizes
pass_near             0 20   distance of the lowest point's path from it while it rests, smallest, sizes
pass_near_fast        0 20   the same of steps of more than 0.3 sizes
pass_through          0 20   path of the lowest point within 0.6 sizes of it while it rests
tool_inside           0 1    share of frames with the lowest point within half a size of its middle
ring_max              0 1    share of the pixels around it that are robot, largest
ring_mean             0 1    the same, mean while the robot touches it
ring_last             0 1    the same, mean of the last three frames
hollow_max            0 1    share of its convex hull that is something else, largest
hollow_touch          0 1    the same, mean while the robot touches it
hollow_free           0 1    the same, largest while the robot does not
outline_tall_clear_max  -20 20  log of its extent in rows against the reference, largest of uncovered frames
outline_tall_clear_min  -20 20  the same, smallest
outline_tall_clear_last -20 20  the same, median of the last three
outline_tall_seen_last  -20 20  the same of the last three frames that show it
outline_tall_seen_most  -20 20  85 % quantile of all that show it
outline_tall_step       0 20  its largest step while no robot is near and it stays
outline_tall_start      0 20  its largest size while no robot is near and it is where it began
outline_tall_end        0 20  its range while no robot is near and it is where it ends
outline_wide_clear_max  -20 20  log of its extent in columns against the reference, largest of uncovered frames
outline_wide_clear_min  -20 20  the same, smallest
outline_wide_clear_last -20 20  the same, median of the last three
outline_wide_seen_last  -20 20  the same of the last three frames that show it
outline_wide_seen_most  -20 20  85 % quantile of all that show it
outline_wide_step       0 20  its largest step while no robot is near and it stays
outline_wide_start      0 20  its largest size while no robot is near and it is where it began
outline_wide_end        0 20  its range while no robot is near and it is where it ends
outline_area_clear_max  -20 20  log of its coloured area against the reference, largest of uncovered frames
outline_area_clear_min  -20 20  the same, smallest
outline_area_clear_last -20 20  the same, median of the last three
outline_area_seen_last  -20 20  the same of the last three frames that show it
outline_area_seen_most  -20 20  85 % quantile of all that show it
outline_area_step       0 20  its largest step while no robot is near and it stays
outline_area_start      0 20  its largest size while no robot is near and it is where it began
outline_area_end        0 20  its range while no robot is near and it is where it ends
outline_long_clear_max  -20 20  log of longer over shorter extent less the reference's, largest of uncovered frames
outline_long_clear_min  -20 20  the same, smallest
outline_long_clear_last -20 20  the same, median of the last three
outline_long_seen_last  -20 20  the same of the last three frames that show it
outline_long_seen_most  -20 20  85 % quantile of all that show it
outline_long_step       0 20  its largest step while no robot is near and it stays
outline_long_start      0 20  its largest size while no robot is near and it is where it began
outline_long_end        0 20  its range while no robot is near and it is where it ends
asks_above            0 1    the instruction says "above"
target_start          0 20   distance of the object from the target's middle in the reference, 1 is its edge
target_end            0 20   the same, last frame
target_min            0 20   the same, smallest
target_progress      -2 2    share of the way to the target's edge that the object went
tool_above_end      -20 20   how far the lowest point is above the object at the end, sizes
tool_beside_end       0 20   how far it is beside it at the end, sizes
tool_near_end         0 29   distance of the two at the end, sizes
tool_nearer         -20 20   by how much that is less than at the start, sizes
scene_away_mean       0 255  difference of scene cells from the reference, levels, mean over time
scene_away_first      0 255  the same, first frame
scene_away_last       0 255  the same, last frame
scene_away_step    -255 255  its largest step up
scene_tile_away_low   0 255  30 % quantile over tiles of the last frame's difference, levels
scene_changed         0 1    share of scene cells that differ by more than 10 levels, mean over time
scene_changed_last    0 1    the same, last frame
scene_changed_first   0 1    the same, first frame
scene_offset_last     0 442  length of the scene's median change of colour, levels, last frame
scene_offset_max      0 442  the same, largest
scene_offset_step     0 442  its largest step
scene_texture         0 inf  |Laplacian| of scene cells against the reference, mean over time
scene_texture_min     0 inf  the same, least
scene_tile_texture    0 inf  the same of the poorest tile and frame
scene_spread          0 inf  standard deviation of scene colours against the reference
scene_share           0 1    share of cells that are scene here and in the reference
camera_start          0 inf  shift from the reference to the first frame, px of a picture 96 px wide
camera_shift          0 inf  summed shift at the end, such px
camera_turn           0 inf  summed roll at the end, degrees
camera_growth         0 inf  summed relative growth at the end
camera_shake          0 inf  median shift per step, such px
camera_shake_mean     0 inf  mean shift per step, such px
camera_turning        0 inf  median roll per step, degrees
camera_left           0 255  difference of the scene that no camera motion explains, levels
camera_difference     0 255  difference of the blurred last frame from the reference, levels
clutter_kept          0 1    share of the uninvolved things' pixels that still show a thing, later half, mean of things
clutter_kept_least    0 1    the same of the thing that is kept least
clutter_area          0 inf  area of uninvolved things against the reference, mean over time
clutter_area_last     0 inf  the same, last frame
object_hue_turn       0 180  turn of the object's mean hue against the reference, degrees, median over time
object_hue_turn_last  0 180  the same, last frame that shows it
object_repainted      0 inf  its change of colour apart from brightness, levels, median over time
object_repainted_max  0 inf  the same, largest
object_colourful     -4 inf  change of its chroma over its reference brightness
robot_repainted       0 inf  the robot's change of colour apart from brightness, levels, median over time
robot_repainted_max   0 inf  the same, largest
named_hue_off         0 180  the object's hue against the colour that the instruction names, degrees
robot_second_max      0 1    area of the robot's second part over the whole, largest
robot_first           0 inf  the robot's area against the reference, first frame
robot_area_max        0 1    its largest area, share of the picture
robot_area_step       0 1    largest step of its area over the largest area
share_unsure          0 1    share of pixels whose class a 3 x 3 median of classes changes
"""


def _parsed() -> dict[str, Definition]:
    found = {}
    for line in _TABLE.strip().splitlines():
        name, low, high, text = line.split(maxsplit=3)
        found[name] = Definition(float(low), float(high), text)
    return found


EVIDENCE = _parsed()
"""Name -> definition, in no particular order."""
