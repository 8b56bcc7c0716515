// Colours of objects by their category.
const COLOURS = {
  car: "#5aa9ff",
  truck: "#b48cff",
  van: "#62d0c4",
  bus: "#b48cff",
  pedestrian: "#ff8fa3",
  cyclist: "#ffd166",
};
export const colourOf = ({ category }) => COLOURS[category] ?? COLOURS.car;
